"""The section of the report that says which generated frames the gate refused; see `postprocessing/rejection.py`."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass

from ctlev_core.report.page.html import Section, Table
from data_contracts.manifest import Manifest

_CAPTION = (
    "A frame is refused where a number of it lies far outside those of real training frames: no event image at all. "
    "Refused frames are sampled again, from other seeds, until they pass or run out of tries; then they stay."
)


@dataclass(frozen=True)
class Refusals:
    """What the gate did to some generated frames.

    Attributes:
        num_rows: frames.
        num_again: that were sampled more than once.
        num_refused: whose last try was refused as well.
        causes: how many of those for each cause, most frequent first.
    """

    num_rows: int
    num_again: int
    num_refused: int
    causes: dict[str, int]

    def __str__(self) -> str:
        causes = ", ".join(f"{cause} {count}" for cause, count in self.causes.items())
        text = f"{self.num_rows} frames, {self.num_again} sampled again, {self.num_refused} refused to the last"
        return f"{text} ({causes})" if causes else text


def count_refusals(generated: Manifest) -> Refusals:
    """From a manifest of the table `synthetic`."""
    causes = Counter(text.partition(":")[0] for text in generated.column("refused") if text)
    num_again = sum(tries > 1 for tries in generated.column("num_tries"))
    return Refusals(len(generated), num_again, causes.total(), dict(causes.most_common()))


def refusal_sections(generated: Mapping[str, Manifest]) -> list[Section]:
    """One table for all generators, by name."""
    found = {name: count_refusals(manifest) for name, manifest in generated.items()}
    if not any(counts.num_again or counts.num_refused for counts in found.values()):
        return []
    body = [
        [name, counts.num_rows, counts.num_again, counts.num_refused, ", ".join(counts.causes) or None]
        for name, counts in found.items()
    ]
    columns = ["frames", "sampled", "sampled again", "refused to the last", "because"]
    return [Table("What the gate refused", columns, body, caption=_CAPTION)]
