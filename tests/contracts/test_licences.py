"""Licences of all that `pip install` brings along with ctlev: known, allowed, and listed in docs/licences.md.

python tests/contracts/test_licences.py > docs/licences.md     after a new dependency
"""

import importlib.metadata
import re
from pathlib import Path

from packaging.requirements import Requirement

PAGE = Path(__file__).parents[2] / "docs" / "licences.md"
ALLOWED = re.compile(
    r"MIT(?:-0|-CMU| License)?|(?:0|3-Clause )?BSD(?:-\d-Clause| License)?|PSF-2\.0|CC0-1\.0|Zlib|BSL-1\.0|CNRI-Python"
    r"|Apache(?:-2\.0| 2\.0 License| Software License)|ISC(?: License \(ISCL)?|Artistic License|LLVM-exception"
    r"|MPL-2\.0|Mozilla Public License 2\.0 \(MPL 2\.0"
)
TOLD_ELSEWHERE = {"aedat": "MIT", "pyglet": "BSD License"}
"""By the project's own file, where the package's metadata say nothing."""
CHOSEN = {"text-unidecode": "Artistic License"}
"""Of several licences of which one may be chosen."""
OF_NEWER_PYTHONS = {"whenever": "MIT"}
"""What Prefect needs from Python 3.13 on, in the place of pendulum."""
OF_GPUS = ("nvidia-", "cuda-", "triton")
"""What torch brings where there is a GPU; the page says so."""
HEAD = """# Licences

ctlev has the MIT licence. `pip install ctlev` brings these packages along, each under its own licence; on other systems
a few more or fewer. Extras bring others, and torch for GPUs brings NVIDIA's libraries, under NVIDIA's licence. The
weights in the repository are ours, under the same licence as the code ([weights](weights.md)); datasets and Stable
Diffusion are not part of it.

| package | licence |
|---|---|
"""


def required():
    """Distributions that ctlev needs, with those that they need, by name."""
    found, waiting = {}, [("ctlev", frozenset())]
    for name, extras in waiting:
        key = re.sub(r"[-_.]+", "-", name).lower()
        if key in found or key.startswith(OF_GPUS):
            continue
        try:
            found[key] = importlib.metadata.distribution(name)
        except importlib.metadata.PackageNotFoundError:
            continue  # for another platform
        for line in found[key].requires or []:
            wanted = Requirement(line)
            if wanted.marker is None or any(wanted.marker.evaluate({"extra": one}) for one in ("", *extras)):
                waiting.append((wanted.name, frozenset(wanted.extras)))
    return found


def licence_of(name, distribution):
    """What the package says of itself."""
    metadata = distribution.metadata
    classifiers = [
        line.split(" :: ")[-1] for line in metadata.get_all("Classifier") or [] if line.startswith("License")
    ]
    first = (metadata.get("License") or "").strip().partition("\n")[0]
    said = metadata.get("License-Expression") or "; ".join(classifiers) or first
    return CHOSEN.get(name) or said or TOLD_ELSEWHERE.get(name, "")


def test_every_licence_is_one_that_asks_nothing_of_what_uses_it():
    for name, distribution in required().items():
        parts = [part.strip("()") for part in re.split(r" AND | OR | WITH |; ", licence_of(name, distribution))]
        assert parts and all(ALLOWED.fullmatch(part) for part in parts), (name, parts)


def test_the_page_lists_them():
    listed = dict(re.findall(r"^\| (\S+) \| (.+) \|$", PAGE.read_text(), re.MULTILINE))
    for name, distribution in required().items():
        assert listed.get(name) == licence_of(name, distribution), f"{name}: see the top of {__file__}"


if __name__ == "__main__":
    found = {name: licence_of(name, one) for name, one in required().items()}
    rows = sorted((OF_NEWER_PYTHONS | found).items())
    print(HEAD + "\n".join(f"| {name} | {licence} |" for name, licence in rows))
