"""Sample labelled synthetic frames from a fine-tuned generator."""

from __future__ import annotations

from typing import Any

import numpy as np
import pyarrow as pa

from ctlev_core import plugins
from data_contracts import tables
from data_contracts.config import SamplingChoice
from data_contracts.manifest import LABEL_COLUMNS, Manifest, conditions_of
from tasks.stage import Output, stage


@stage(version=2, schema=tables.SYNTHETIC)
def sample(out: Output, checkpoint: Manifest, conditions: Manifest, *, sampling: SamplingChoice, seed: int) -> pa.Table:
    """One frame per condition row, each from a seed of its own; the labels come along unchanged."""
    plugin = plugins.load_options(sampling)
    count = len(conditions)
    seeds = [int(np.random.SeedSequence([seed, row]).generate_state(1)[0]) for row in range(count)]
    folder = checkpoint.ref.path / "checkpoint"
    frames = plugin.module.sample(folder, conditions_of(conditions), plugin.options, seeds=seeds, work=out.work)
    out.write_array("frames", frames)
    # Generators that are no diffusion models make an image in one step, without scheduler or guidance.
    options: dict[str, Any] = plugin.options.model_dump()
    same = {
        "split": "train",
        "generator": f"{plugin.name} {plugin.version}",
        "checkpoint_digest": checkpoint.ref.digest,
        "scheduler": options.get("scheduler", ""),
    }
    names = [f"synthetic/{row:06d}" for row in range(count)]
    carried = ("source_id", "subject", "class_name", "prompt", "joint_set", *LABEL_COLUMNS.values())
    return pa.table(
        {
            "sample_id": names,
            "recording_id": names,
            "condition_id": conditions.table["sample_id"],
            **{name: conditions.table[name] for name in carried},
            **{name: pa.array([value] * count, pa.string()) for name, value in same.items()},
            "num_inference_steps": pa.array([options.get("num_inference_steps", 1)] * count, pa.int32()),
            "guidance_scale": pa.array([float(options.get("guidance_scale", 1.0))] * count, pa.float64()),
            "seed": pa.array(seeds, pa.int64()),
        }
    )
