"""Every benchmark of this folder, one after the other, and one page of what they found.

    pip install -c constraints.txt -e '.[bench]'
    python benchmarks/run_all.py                    # two hours on an idle machine; writes benchmarks/RESULTS.md
    python benchmarks/run_all.py training metrics   # these anew, the others as they were last found

What each printed is kept in `build/benchmarks`. Lines that say whether a target was met are shown first; the page says
which benchmarks failed, and which were not run because they need a GPU that is not there. What is not run anew stays on
the page as it is, also what was written by hand.
"""

from __future__ import annotations

import argparse
import json
import re
import subprocess
import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import torch
from interleaved import describe_machine

HERE = Path(__file__).resolve().parent
KEPT = HERE.parent / "build" / "benchmarks"
RESULTS = HERE / "RESULTS.md"
JUDGED = re.compile(r"\b(met|missed|every target)\b", re.IGNORECASE)


@dataclass(frozen=True)
class Benchmark:
    """A script and how it is called here."""

    name: str
    arguments: tuple[str, ...] = ()
    needs_gpu: bool = False
    script: str = ""
    """Its file, where that has another name."""


ALL = (
    Benchmark("events"),
    Benchmark("rendering"),
    Benchmark("sensor", ("--plot", "build/sensor.png")),
    Benchmark("metrics", ("--figure", "build/metrics.png")),
    Benchmark("downstream"),
    Benchmark("training"),
    Benchmark("training_compiled", ("--set", "compile_networks=true"), script="training"),
    Benchmark("time_to_loss"),
    Benchmark("sampling"),
    Benchmark("arrays"),
    Benchmark("operations"),
    Benchmark("many_recordings", ("20000",)),
    Benchmark("formats"),
    Benchmark("sweeps"),
    Benchmark("growth", ("--largest", "2000", "--figure", "build/growth.png")),
    Benchmark("gpu", needs_gpu=True),
)


@dataclass(frozen=True)
class Outcome:
    """What a benchmark printed, and of which code."""

    name: str
    command: str
    status: int
    seconds: float
    date: str
    commit: str
    machine: str
    output: str

    @property
    def judged(self) -> list[str]:
        """The lines that say whether a target was met, with what some of them list below."""
        found: list[str] = []
        listed = False
        for line in self.output.splitlines():
            listed = (listed and line.startswith(" ")) or bool(JUDGED.search(line))
            if listed:
                found.append(line.strip())
            listed = listed and (line.endswith(":") or line.startswith(" "))
        return found


def main() -> int:
    """Run what is asked for and write the page; the status says how many failed."""
    names = [benchmark.name for benchmark in ALL]
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(names)}; all without")
    chosen = parser.parse_args().names or names
    unknown = sorted(set(chosen) - set(names))
    if unknown:
        parser.error(f"no such benchmark: {', '.join(unknown)}; there are {', '.join(names)}")
    KEPT.mkdir(parents=True, exist_ok=True)
    failed = 0
    for benchmark in (benchmark for benchmark in ALL if benchmark.name in chosen):
        if benchmark.needs_gpu and not _has_gpu():
            print(f"{benchmark.name}: not run, there is no GPU", flush=True)
            continue
        outcome = run(benchmark)
        failed += outcome.status != 0
        (KEPT / f"{benchmark.name}.json").write_text(json.dumps(asdict(outcome), indent=1))
        page = RESULTS.read_text(encoding="utf-8") if RESULTS.exists() else ""
        RESULTS.write_text(render([_kept(one.name) for one in ALL], page), encoding="utf-8")
    print(f"wrote {RESULTS}")
    return failed


def run(benchmark: Benchmark) -> Outcome:
    """Run one script; what it prints is shown as it comes, and kept."""
    script = f"{benchmark.script or benchmark.name}.py"
    command = [sys.executable, "-u", str(HERE / script), *benchmark.arguments]
    said = " ".join(["python", f"benchmarks/{script}", *benchmark.arguments])
    print(f"\n== {said}", flush=True)
    started, lines = time.perf_counter(), []
    with subprocess.Popen(
        command, cwd=HERE.parent, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, errors="replace"
    ) as process:
        assert process.stdout is not None
        for line in process.stdout:
            print(line, end="", flush=True)
            # Of a progress bar, what it ended in; of warnings, not where this copy lies.
            lines.append(line.rpartition("\r")[2].rstrip().replace(f"{HERE.parent}/", ""))
    return Outcome(
        name=benchmark.name,
        command=said,
        status=process.returncode,
        seconds=time.perf_counter() - started,
        date=time.strftime("%Y-%m-%d", time.gmtime()),
        commit=_commit(),
        machine=describe_machine(torch.device("cuda" if benchmark.needs_gpu else "cpu")),
        output="\n".join(lines).strip(),
    )


def render(outcomes: list[Outcome | None], page: str = "") -> str:
    """The page, from what is known of each benchmark in the order of `ALL`, and of the others from an earlier page."""
    before = _sections(page)
    sections, missing = [], []
    for benchmark, outcome in zip(ALL, outcomes, strict=True):
        section = before.pop(benchmark.name, None)
        section = section if outcome is None else _section(outcome)
        if section is None:
            missing.append(f"`{benchmark.name}`")
        else:
            sections.append(section)
    parts = ["# Benchmarks", "Made by `python benchmarks/run_all.py`; ratios are within one run, on the machine named."]
    if missing:
        parts.append(f"Not run here: {', '.join(missing)}.")
    return "\n\n".join([*parts, *sections, *before.values()]) + "\n"


def _section(outcome: Outcome) -> str:
    ended = "" if outcome.status == 0 else f" **It ended with status {outcome.status}.**"
    judged = "\n".join(f"- {line}" for line in outcome.judged) or "It judges no target."
    return (
        f"## {outcome.name}\n\n"
        f"`{outcome.command}`, {outcome.date}, commit {outcome.commit}, {outcome.seconds / 60:.1f} min.{ended}\n\n"
        f"{outcome.machine}\n\n{judged}\n\n"
        f"<details><summary>All it printed</summary>\n\n```\n{outcome.output}\n```\n\n</details>"
    )


def _sections(page: str) -> dict[str, str]:
    """The sections of a page by their names."""
    parts = re.split(r"^## ", page, flags=re.MULTILINE)[1:]
    return {part.partition("\n")[0].strip(): f"## {part.rstrip()}" for part in parts}


def _kept(name: str) -> Outcome | None:
    path = KEPT / f"{name}.json"
    return Outcome(**json.loads(path.read_text())) if path.exists() else None


def _commit() -> str:
    """The commit that was measured, with a plus where files differ from it."""
    command = ["git", "describe", "--always", "--dirty=+", "--abbrev=12"]
    found = subprocess.run(command, cwd=HERE, capture_output=True, text=True, check=False)
    return found.stdout.strip() or "unknown"


def _has_gpu() -> bool:
    return torch.cuda.is_available()


if __name__ == "__main__":
    sys.exit(main())
