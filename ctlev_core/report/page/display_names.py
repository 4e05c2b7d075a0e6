"""What a reader sees in the place of the names that tables, options and scores have in code.

Every name here is a text that remembers the code name, which pages show when the pointer rests on it. A name that is
not known is shown with spaces for underscores.
"""

from __future__ import annotations

import re

from ctlev_core.scoring.score_info import find_score, lower_is_better
from data_contracts.training_sets import LABEL_CONSISTENT, ORACLE, RECORDED, SYNTHETIC, LabelAgreement, TrainingSet

SOURCES = {
    RECORDED: "recorded",
    SYNTHETIC: "synthetic",
    "augmentation": "augmented copies",
    "random_weights": "synthetic (random weights)",
    "no_base_model": "synthetic (no base model)",
    "event_gan": "Event-GAN",
    "gan": "GAN",
    "coverage": "synthetic (covering poses)",
    "hard": "synthetic (hard poses)",
    "smpl_esim": "simulated (SMPL-ESIM)",
    "simulator": "simulated",
    "out_of_domain_poses": "synthetic (other motions)",
    "amass_poses": "synthetic (AMASS motions)",
    ORACLE: "more recorded",
    LABEL_CONSISTENT: "synthetic (clearest labels)",
}
"""Whose frames, in the order in which they are read."""
_FINE_TUNINGS = re.compile(r"(base_model|random)_(\d+)")
_STARTS = {"base_model": "pre-trained weights", "random": "random weights"}

_ALIGNED = {"pelvis": ", pelvis-aligned", "pa": ", Procrustes-aligned", "": ""}
_METRICS = (
    (r"accuracy", "accuracy", ""),
    (r"macro_(precision|recall)", "{0}, mean over classes", ""),
    (r"macro_f1", "F1, mean over classes", ""),
    (r"chance_accuracy", "accuracy by chance", ""),
    (r"calibration_error_.+", "calibration error", ""),
    (r"binary_accuracy_mean", "one-against-rest accuracy", ""),
    (r"binary_accuracy_(.+)", "one-against-rest accuracy, {0}", ""),
    *(
        (rf"mpjpe2d_{sensor}{protocol}{counted}px", f"2D joint error (MPJPE{by}{of})", unit)
        for sensor, unit in (("", "px"), ("sensor_", "sensor px"))
        for protocol, by in (("", ""), ("dhp19_", ", DHP19 protocol"))
        for counted, of in (("", ""), ("known_", ", known joints"))
    ),
    (r"mpjpe3d_(?:(pelvis|pa)_)?mm", "3D joint error (MPJPE{aligned})", "mm"),
    (r"pve_(?:(pelvis|pa)_)?mm", "surface error (PVE{aligned})", "mm"),
    (r"pck_px([\d.]+)", "joints within {0} px (PCK)", ""),
    (r"pck_(torso|head)([\d.]+)", "joints within {1} {0} lengths (PCK)", ""),
    (r"pck3d_(?:(pelvis|pa)_)?([\d.]+)mm", "joints within {1} mm (3D PCK{aligned})", ""),
    (r"pckh3d_(?:(pelvis|pa)_)?([\d.]+)", "joints within {1} head lengths (3D PCKh{aligned})", ""),
    (r"auc3d_(?:(pelvis|pa)_)?([\d.]+)mm", "area under 3D PCK up to {1} mm (AUC{aligned})", ""),
    (r"oks_ap([\d.]+)", "poses with OKS from {0} % (AP)", ""),
    (r"oks_mean", "pose similarity (OKS)", ""),
    (r"fd(?:_event_.+)?", "Frechet distance", ""),
    (r"fd_to_.+", "Frechet distance to given statistics", ""),
    (r"fid", "FID", ""),
    (r"fd_infinity(?:_event_.+)?", "Frechet distance, infinitely many frames", ""),
    (r"fid_infinity", "FID, infinitely many frames", ""),
    (r"kid(?:_event_.+)?", "kernel distance (KID)", ""),
    (r"mmd(?:_event_.+)?", "kernel distance (MMD)", ""),
    (r"mmd_sigma([^_]+)(?:_event_.+)?", "kernel distance (MMD, bandwidth {0})", ""),
    (r"(precision|recall|density|coverage)_k(\d+)(?:_event_.+)?", "{0} ({1} neighbours)", ""),
    (r"close_share", "close copies", "share"),
    (r"duplicates", "exact copies", ""),
    (r"nearest_distance_ratio", "distance to the nearest, ratio", ""),
    (r"data_copying_z", "data-copying test (C_T)", ""),
    (r"authentic_share", "authentic frames", "share"),
    (r"c2st", "told apart (C2ST area)", ""),
    (r"event_rate_mev_s", "event rate", "million/s"),
    (r"pixel_rate_hz", "event rate of a pixel", "Hz"),
    (r"noise_rate_hz", "noise rate of a pixel", "Hz"),
    (r"positive_share", "positive events", "share"),
    (r"(active|hot|isolated)_pixel_share", "{0} pixels", "share"),
    (r"hot_event_share", "events of hot pixels", "share"),
    (r"isolated_share", "isolated events", "share"),
    (r"speckle_share", "speckle", "share"),
    (r"spread", "spread over the sensor", ""),
    (r"value_mean", "brightness of active pixels", "grey levels"),
    (r"rms_contrast", "contrast (RMS)", ""),
    (r"neighbour_correlation", "correlation of neighbours", ""),
    (r"rate_correlation_lag1", "activity one frame later, correlation", ""),
    (r"rate_correlation_lag2", "activity two frames later, correlation", ""),
    (r"rate_correlation_lag4", "activity four frames later, correlation", ""),
    (r"persistent_share", "active pixels that stay", "share"),
    (r"still_active_share", "still pixels that are active", "share"),
    (r"still_repeat_ratio", "still pixels active again, against chance", ""),
    (r"flow_agreement", "motion along the labelled one, cosine", ""),
    (r"polarity_kept_share", "polarity that stays", "share"),
    (r"(pixel_rate|interval|value|power_spectrum)_wasserstein_(.+)", "{axis}, Wasserstein distance", "{unit}"),
    (r"(pixel_rate|interval|value|power_spectrum)_js_bits", "{axis}, Jensen-Shannon divergence", "bits"),
)
"""Code name, what it is called, and its unit."""
_AXES = {
    "pixel_rate": "event rates of pixels",
    "interval": "intervals between events",
    "value": "brightness",
    "power_spectrum": "power spectrum",
}
STAGES = {
    "ingest": "Recordings",
    "encode": "Recorded event frames",
    "condition_frames": "Conditions of recorded frames",
    "condition_samples": "Conditions to sample from",
    "cover_labels": "Choice of labels, coverage",
    "find_hard_labels": "Choice of labels, hard ones",
    "take_fold": "Folds of the recorded frames",
    "pretrain": "Base model",
    "encode_latents": "Latents of recorded frames",
    "finetune": "Training of generators",
    "sample": "Sampled frames",
    "simulate": "Simulated frames",
    "take_label_consistent": "Frames with the clearest labels",
    "take_share": "Parts of the synthetic frames",
    "train_downstream": "Training of downstream models",
    "score_model": "Scores of models",
    "score_distance": "Distances",
    "event_realism": "Statistics of recordings",
    "realism_floors": "Recorded frames compared",
    "realism": "Statistics of frames",
    "sequence_realism": "Statistics of sequences",
    "memorisation": "Search for copies",
    "nearest_seen": "Nearest seen classes",
    "report": "Report",
}


class Name(str):
    """A text for readers, with the name in code that it stands for."""

    code: str

    def __new__(cls, text: str, code: str) -> Name:
        """Of a text that is the code name itself, nothing is remembered."""
        name = super().__new__(cls, text)
        name.code = "" if text == code else code
        return name


def metric_words(code: str) -> tuple[str, str]:
    """A score in words, and its unit; the latter is empty for shares and numbers without one."""
    for pattern, words, unit in _METRICS:
        found = re.fullmatch(pattern, code)
        if found:
            parts = [part or "" for part in found.groups()]
            named = {"aligned": _ALIGNED.get(parts[0], ""), "axis": _AXES.get(parts[0], "")} if parts else {}
            return words.format(*parts, **named), unit.format(unit=parts[-1].replace("_", " ") if parts else "")
    return code.replace("_", " "), ""


def metric_name(code: str) -> Name:
    """`2D joint error (MPJPE), px`."""
    return Name(", ".join(filter(None, metric_words(code))), code)


def metric_heading(code: str) -> Name:
    """The same with an arrow in the direction that is better, where there is one."""
    if find_score(code).is_reference:
        return metric_name(code)
    return Name(f"{metric_name(code)} {'↓' if lower_is_better(code) else '↑'}", code)


def set_name(code: str) -> Name:
    """What a model was trained on, or whose frames: `recorded + 50 % of synthetic`."""
    try:
        sources = TrainingSet.parse(code).sources
    except ValueError:
        return Name(code.replace("_", " "), code)
    parts = [
        _source(one.name) if one.share == 1 else f"{one.share * 100:.3g} % of {_source(one.name)}" for one in sources
    ]
    return Name(" + ".join(parts), code)


def _source(code: str) -> str:
    found = _FINE_TUNINGS.fullmatch(code)
    if found:
        return f"synthetic ({_STARTS[found[1]]}, {found[2]} steps)"
    return SOURCES.get(code, code.replace("_", " "))


def subject_name(code: str) -> Name:
    """The subject of a score: a training set, frames, or frames against their labels."""
    labels = LabelAgreement.parse(code)
    if labels is None:
        return set_name(code)
    return Name(f"{set_name(labels.generator)}{' (shuffled labels)' if labels.shuffled else ''}", code)


def stage_name(code: str) -> Name:
    """A stage as what it makes."""
    return Name(STAGES.get(code, code.replace("_", " ").capitalize()), code)


def role_name(code: str) -> Name:
    """What a record is in its experiment: `model of recorded+synthetic, seed 0`, and what lies behind it."""
    parts = []
    for part in code.split(" / "):
        found = re.fullmatch(r"(.* of )(.+?)((?:, seed \d+)?(?:, distance)?(?: \(\d+\))?)", part)
        parts.append(f"{found[1]}{subject_name(found[2])}{found[3]}" if found else part.replace("_", " "))
    return Name(" / ".join(parts), code)
