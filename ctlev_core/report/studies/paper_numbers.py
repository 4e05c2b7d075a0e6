"""The numbers of the paper's Tables 1 to 5, to be read beside an experiment's own and never against them.

Source: Hu et al., ControlEvents, WACV 2026. They were measured on N-ImageNet, DHP19, CDEHP, Event-HPE and N-Caltech101
with Stable Diffusion as the base model. Bold is the paper's; it gives no intervals.
"""

from __future__ import annotations

from ctlev_core.report.page.html import Folded
from ctlev_core.report.page.tables import Table

REAL, BOTH = "original training data", "Ours + original training data"

CLASSIFICATION = Table(
    "Paper, Table 1: object recognition on N-ImageNet, ResNet-34",
    ["trained on", "Acc. ↑", "Prec. ↑"],
    [
        [REAL, "39.33", "40.02"],
        ["Ours", "27.00", "23.32"],
        [BOTH, "45.33", "46.52"],
    ],
    bold={(2, 1), (2, 2)},
)
POSE_2D = Table(
    "Paper, Table 2: 2D pose on DHP19 and CDEHP",
    [
        "trained on", "DHP19 2D-MPJPE ↓", "DHP19 AP@25 ↑", "DHP19 AP@50 ↑", "CDEHP 2D-MPJPE ↓", "CDEHP AP@25 ↑",
        "CDEHP AP@50 ↑",
    ],
    [
        [REAL, "7.180", "99.5", "98.0", "12.149", "98.2", "95.9"],
        ["Event-GAN", "7.986", "98.4", "98.0", "16.264", "97.5", "94.1"],
        ["Ours", "6.223", "99.7", "99.1", "10.936", "98.8", "96.5"],
        [BOTH, "6.006", "99.7", "99.4", "10.792", "98.9", "96.7"],
    ],
    bold={(2, 2), *((3, column) for column in range(1, 7))},
)  # fmt: skip
BODY_3D = Table(
    "Paper, Table 3: 3D body on Event-HPE",
    ["trained on", "3D-MPJPE mm ↓", "3D-PCK@25 ↑", "3D-PCK@50 ↑", "PVE mm ↓", "AUC ↑"],
    [
        [REAL, "27.30", "46.05", "95.02", "34.24", "81.79"],
        ["Event-GAN", "29.43", "35.61", "91.79", "35.27", "80.37"],
        ["SMPL-ESIM", "53.53", "5.84", "42.54", "55.35", "36.44"],
        ["Ours w/ Event-HPE pose", "25.13", "54.97", "96.45", "34.22", "83.24"],
        ["Ours w/ AMASS pose", "28.32", "45.11", "92.59", "34.36", "81.12"],
        ["Ours both + original training data", "18.65", "79.37", "99.66", "32.12", "87.57"],
    ],
    bold={(5, column) for column in range(1, 6)},
)
DISTANCES = Table(
    "Paper, Table 4: FID to real training data",
    ["frames", "SMPL ↓", "skeleton ↓", "class ↓"],
    [
        ["Unseen real event data", "3.64", "23.22", "0.36"],
        ["Event-GAN", "196.41", "165.93", None],
        ["SMPL-ESIM", "206.23", None, None],
        ["Ours", "15.55", "28.97", "27.43"],
    ],
    caption="In features of an Inception network: not comparable with distances in other features.",
    bold={(3, 1), (3, 2), (3, 3)},
)
ZERO_SHOT = Table(
    "Paper, Table 5: zero-shot binary accuracy on N-Caltech101, %",
    ["class", "Baseline ↑", "Ours ↑"],
    [
        ["bonsai", "55.00", "76.25"],
        ["ceiling fan", "85.06", "67.82"],
        ["ferry", "60.22", "68.82"],
        ["joshua tree", "61.54", "70.51"],
        ["minaret", "54.44", "60.00"],
        ["pagoda", "65.15", "80.30"],
        ["sunflower", "60.00", "74.67"],
        ["water lilly", "72.41", "55.17"],
        ["windsor chair", "62.16", "58.11"],
        ["chandelier", "58.02", "70.37"],
    ],
    caption="Baseline: trained on 50 real images a class. Ours: on 500 synthetic ones, of classes never seen.",
    bold={(0, 2), (1, 1), (2, 2), (3, 2), (4, 2), (5, 2), (6, 2), (7, 1), (8, 1), (9, 2)},
)
TABLES = (CLASSIFICATION, POSE_2D, BODY_3D, DISTANCES, ZERO_SHOT)


def paper_section() -> Folded:
    """All five tables, closed."""
    caption = (
        "Other data, other base models, other sizes: these numbers of the paper (Hu et al., ControlEvents, WACV 2026) "
        "say what its authors found on real datasets, and none of them is comparable with a number of this report. The "
        "paper gives no intervals; bold is the paper's."
    )
    return Folded("The paper's own numbers, on other data", TABLES, caption)
