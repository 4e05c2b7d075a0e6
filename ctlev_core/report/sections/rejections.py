"""The section of the report on generated frames that the quality filter rejected."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass

from ctlev_core.report.page.display_names import set_name
from ctlev_core.report.page.html import Section, Table
from data_contracts.manifest import Manifest

_CAPTION = (
    "A frame is rejected where a number of it lies far outside those of recorded training frames: no event image at "
    "all. "
    "Rejected frames are sampled again, from other seeds, until they pass or run out of attempts; then they stay."
)


@dataclass(frozen=True)
class Rejections:
    """What the quality filter did to some generated frames.

    Attributes:
        num_rows: frames.
        num_again: that were sampled more than once.
        num_rejected: whose last attempt was rejected too.
        causes: how many of those for each cause, most frequent first.
    """

    num_rows: int
    num_again: int
    num_rejected: int
    causes: dict[str, int]

    def __str__(self) -> str:
        causes = ", ".join(f"{cause} {count}" for cause, count in self.causes.items())
        text = f"{self.num_rows} frames, {self.num_again} sampled again, {self.num_rejected} rejected to the last"
        return f"{text} ({causes})" if causes else text


def count_rejections(generated: Manifest) -> Rejections:
    """From a manifest of the table `synthetic`."""
    causes = Counter(text.partition(":")[0] for text in generated.column("rejected") if text)
    num_again = sum(tries > 1 for tries in generated.column("num_attempts"))
    return Rejections(len(generated), num_again, causes.total(), dict(causes.most_common()))


def rejection_sections(generated: Mapping[str, Manifest]) -> list[Section]:
    """One table for all generators, by name."""
    found = {name: count_rejections(manifest) for name, manifest in generated.items()}
    if not any(counts.num_again or counts.num_rejected for counts in found.values()):
        return []
    body = [
        [set_name(name), counts.num_rows, counts.num_again, counts.num_rejected, ", ".join(counts.causes) or None]
        for name, counts in found.items()
    ]
    columns = ["frames", "sampled", "sampled again", "rejected to the last", "because"]
    return [Table("What the quality filter rejected", columns, body, caption=_CAPTION)]
