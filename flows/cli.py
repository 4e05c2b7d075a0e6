"""The command `ctlev`: every subcommand with its arguments. What they do is imported when one is called.

The scripts beside this file (`python flows/synthesize.py ...`) are single subcommands of it.
"""

from __future__ import annotations

import importlib
import math
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, NoReturn

import typer

from ctlev_core import __version__
from flows import preset_list

app = typer.Typer(
    name="ctlev",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
SINGLE_RUNS, PARTS, STORE, LOOK_UP = (
    "Experiments",
    "Parts of an experiment",
    "Runs and the store",
    "Presets and options",
)


def _complete_preset(incomplete: str) -> list[tuple[str, str]]:
    heads = preset_list.preset_heads()
    return [(head.name, head.summary) for head in heads if head.name.startswith(incomplete)]


def _complete_report(incomplete: str) -> list[str]:
    from data_contracts.home_folder import home_folder

    return sorted(path.stem for path in (home_folder() / "reports").glob(f"{incomplete}*.html"))


def _complete_option(incomplete: str) -> list[str]:
    from flows.option_list import option_names

    return [f"{name}=" for name in option_names() if name.startswith(incomplete)]


Preset = Annotated[
    str | None,
    typer.Argument(
        metavar="PRESET",
        help="name of a bundled preset (`ctlev presets`), or path of a .yaml file",
        autocompletion=_complete_preset,
        show_default=False,
    ),
]
PresetOption = Annotated[
    str | None, typer.Option("--preset", metavar="PRESET", help="the preset, as an option", show_default=False)
]
Overrides = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="KEY=VALUE",
        help="change an option; repeatable (`ctlev options PRESET` lists them)",
        autocompletion=_complete_option,
        show_default=False,
    ),
]
DryRun = Annotated[bool, typer.Option("--dry-run", help="print the plan and run nothing")]
Home = Annotated[
    str | None,
    typer.Option(
        "--home",
        metavar="FOLDER|URL",
        help="folder of all state, or a bucket such as s3://BUCKET/PREFIX (default: CTLEV_HOME, else .ctlev)",
        show_default=False,
    ),
]
Verbose = Annotated[bool, typer.Option("--verbose", help="show Prefect's log")]
Track = Annotated[
    str,
    typer.Option(
        "--track", metavar="TRACKER", help="tell tensorboard, mlflow or wandb of the result", show_default=False
    ),
]
Run = Annotated[
    str,
    typer.Argument(help="name, key or path of a report", autocompletion=_complete_report, show_default=False),
]


def _print_version(asked: bool) -> None:
    if asked:
        print(f"ctlev {__version__}")
        raise typer.Exit


@app.callback()
def _ctlev(
    version: Annotated[
        bool, typer.Option("--version", is_eager=True, callback=_print_version, help="print the version and end")
    ] = False,
) -> None:
    """Labelled event-camera data from a fine-tuned image-diffusion model."""


def main() -> NoReturn:
    """The console script."""
    _call(app, prog_name="ctlev")


def script(name: str) -> NoReturn:
    """Run one subcommand with this process's arguments, as the flow scripts do; ends the process."""
    from flows.settings import leave_script_folder

    leave_script_folder()
    command: Any = typer.main.get_command(app)
    _call(command.commands[name].main, args=sys.argv[1:], prog_name=Path(sys.argv[0]).name)


def _call(command: Callable[..., Any], **arguments: Any) -> NoReturn:
    """Run a command and end the process; where its output cannot be written, with an error that says so."""
    try:
        try:
            command(**arguments)
        finally:
            sys.stdout.flush()
    except OSError as error:  # standard output on a full disk; commands tell of all others themselves
        print(f"error: {error}", file=sys.stderr)
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # what is left would fail again as Python ends
        raise SystemExit(2) from None
    raise SystemExit(0)


def _run(module: str, default: str, given: tuple[str | None, str | None], **asked: Any) -> NoReturn:
    """Run the flow of a module.

    Args:
        module: of `flows`, with a `COMMAND`.
        default: preset.
        given: preset as argument and as option.
        asked: `home`, `verbose`, and the rest of `flows.command_line.Asked`.
    """
    if os.environ.get("LOCAL_RANK", "0") != "0":
        raise typer.Exit(0)  # under `accelerate launch` one process runs the flow; training starts the others itself
    if None not in given and given[0] != given[1]:
        raise typer.BadParameter(f"two presets are named: {given[0]} and --preset {given[1]}")
    from flows.settings import configure

    configure(_home(asked.pop("home")), verbose=asked.pop("verbose", False))
    from flows.command_line import Asked, run_command

    command = importlib.import_module(f"flows.{module}").COMMAND
    overrides = list(asked.pop("overrides") or [])
    preset = next((name for name in given if name is not None), default)  # an empty name is none of a preset
    raise typer.Exit(run_command(command, Asked(preset, overrides, **asked)))


@app.command(rich_help_panel=SINGLE_RUNS)
def run(
    preset: Preset = None,
    preset_option: PresetOption = None,
    overrides: Overrides = None,
    dry_run: DryRun = False,
    home: Home = None,
    track: Track = "",
    verbose: Verbose = False,
) -> None:
    """Run a whole experiment or study, recordings in, a scored report out; by default the preset `demo`.

    What is in the store already is not computed again. `--set num_synthetic=200,400` runs both, in one report.
    """
    _run(
        "full_experiment",
        "demo",
        (preset, preset_option),
        overrides=overrides,
        dry_run=dry_run,
        home=home,
        track=track,
        verbose=verbose,
    )


@app.command(rich_help_panel=SINGLE_RUNS)
def plan(
    preset: Preset = None,
    preset_option: PresetOption = None,
    overrides: Overrides = None,
    home: Home = None,
) -> None:
    """List what `run` would do: each stage, cached or not, with its time, memory and disk, and the total."""
    _run("full_experiment", "demo", (preset, preset_option), overrides=overrides, dry_run=True, costs=True, home=home)


def _part(name: str, module: str, help_text: str, *, default: str = "pose", panel: str = PARTS) -> None:
    """Add the command of a flow that takes a preset, `pose` where none is named."""

    def command(
        preset: Preset = None,
        preset_option: PresetOption = None,
        overrides: Overrides = None,
        dry_run: DryRun = False,
        home: Home = None,
        verbose: Verbose = False,
    ) -> None:
        given = preset, preset_option
        _run(module, default, given, overrides=overrides, dry_run=dry_run, home=home, verbose=verbose)

    app.command(name, help=f"{help_text} PRESET is `{default}` unless named.", rich_help_panel=panel)(command)


_part(
    "prepare", "prepare_dataset", "Read recordings, make event images and conditions, and a contact sheet to look at."
)
_part("train", "train_generator", "Fine-tune a generator on labelled event images.")
_part(
    "synthesize", "synthesize", "Sample labelled event images; `--set export_folder=FOLDER` writes them as plain files."
)
_part("evaluate", "evaluate", "Train downstream models on recorded, synthetic and mixed data, and score them.")
_part("baselines", "baselines", "Make the frames of the baselines, which are asked for the same labels.")
_part("export-events", "export_events", "Write the synthetic frames as event streams.")
_part("speed-vs-error", "speed_vs_error", "Measure samplers and numbers of steps against error.")
_part("realism-chain", "realism_chain", "Send recorded frames through the parts of a generator, to see what is lost.")
_part("pretrain", "pretrain", "Train a small base model on pictures.", default="small")
_part(
    "regenerate",
    "regenerate",
    "Make the next version of the synthetic data, and publish it if it passes its checks.",
    panel=SINGLE_RUNS,
)


@app.command(rich_help_panel=PARTS)
def simulate(
    source: Annotated[
        Path,
        typer.Argument(
            help="a video, a folder of pictures, an AEDAT 4 file with frames, or a picture, moved in saccades",
            show_default=False,
        ),
    ],
    output: Annotated[
        Path, typer.Argument(help="event file; its suffix is its format, .parquet the smallest", show_default=False)
    ],
    sensor: Annotated[
        str, typer.Option(help="kind of camera: ideal, clean, noisy, dvs346, dvxplorer, or a calibration file")
    ] = "noisy",
    noise: Annotated[float, typer.Option(min=0, help="factor on the camera's noise; 0 = none")] = 1.0,
    size: Annotated[
        str, typer.Option(metavar="WxH", help="pixels of the camera, such as 346x260; default: the pictures' own")
    ] = "",
    fps: Annotated[
        float | None, typer.Option(help="frames a second, in the place of the file's times", show_default=False)
    ] = None,
    slow_motion: Annotated[float, typer.Option(help="so many times slower than life the video plays")] = 1.0,
    start: Annotated[float, typer.Option(help="first second of the video that is read")] = 0.0,
    stop: Annotated[float | None, typer.Option(help="last second that is read", show_default=False)] = None,
    interpolation: Annotated[str, typer.Option(help="what lies between two frames: flow, or fade")] = "flow",
    max_displacement_px: Annotated[
        float, typer.Option(help="farthest movement between two drawn frames; smaller is slower and more exact")
    ] = 1.0,
    gamma: Annotated[
        float | None,
        typer.Option(help="light is a stored value to this power; default 2.2, AEDAT 4: 1", show_default=False),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="of the camera's pixels and noise")] = 0,
    format_name: Annotated[
        str, typer.Option("--format", help="format, where the suffix does not tell: evt2, evt3, ...")
    ] = "",
    preview: Annotated[
        Path | None, typer.Option(help="a picture of some frames and their events", show_default=False)
    ] = None,
    marks: Annotated[
        bool,
        typer.Option("--marks", help="mark each event as signal or noise: column `signal`, or a file .signal.npy"),
    ] = False,
    labels: Annotated[
        Path | None,
        typer.Option(help="boxes, keypoints, masks of the frames: COCO .json, or .csv", show_default=False),
    ] = None,
    label_rate_hz: Annotated[
        float | None,
        typer.Option("--label-rate", help="labels a second that are written; default: one a frame", show_default=False),
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="replace what is there")] = False,
) -> None:
    """Turn a video, or pictures, into the events of a simulated camera."""
    from ctlev_core.events.decoding.event_tables import parse_sensor_size
    from ctlev_core.video.frames import FrameOptions
    from flows.simulate import SimulateOptions, simulate_file

    pixels = parse_sensor_size(size) if size else None
    if size and pixels is None:
        raise typer.BadParameter(f"must be WIDTHxHEIGHT in px, such as 346x260, got {size!r}", param_hint="--size")
    if interpolation not in ("flow", "fade"):
        raise typer.BadParameter(f"must be flow or fade, got {interpolation!r}", param_hint="--interpolation")
    try:
        frames = FrameOptions(pixels, fps, slow_motion, start, stop, gamma)
    except ValueError as error:
        raise typer.BadParameter(str(error)) from None
    options = SimulateOptions(
        sensor,
        noise,
        interpolation,
        max_displacement_px,
        seed,
        format_name,
        preview,
        overwrite,
        marks,
        labels,
        label_rate_hz,
    )
    raise typer.Exit(simulate_file(source, output, frames, options))


@app.command(rich_help_panel=PARTS)
def record(
    folder: Annotated[Path, typer.Argument(help="folder to make", show_default=False)],
    recordings: Annotated[int, typer.Option(min=1, help="how many")] = 10,
    split: Annotated[
        str, typer.Option(help="whose people and motions: train, test, validation, or condition (a new person each)")
    ] = "condition",
    rate: Annotated[float, typer.Option(help="labelled moments a second")] = 100.0,
    suffix: Annotated[str, typer.Option(help="of the files of events: .parquet, .h5, .raw, ...")] = ".parquet",
    overrides: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="NAME=VALUE", help="an option of the studio: ctlev options studio"),
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="replace what is there")] = False,
) -> None:
    """Simulate recordings of people with depth, optical flow, masks, boxes and joints."""
    from flows.record import COUNTS, record_people

    if split not in COUNTS:
        raise typer.BadParameter(f"must be one of {', '.join(COUNTS)}, got {split!r}", param_hint="--split")
    raise typer.Exit(
        record_people(
            folder, recordings, overrides or (), split=split, rate_hz=rate, suffix=suffix, overwrite=overwrite
        )
    )


@app.command(rich_help_panel=STORE)
def compare(run_a: Run, run_b: Run, home: Home = None) -> None:
    """Say what differs between two finished experiments: options, data, code and scores."""
    from flows.settings import configure

    folder = configure(_home(home))
    from flows.compare import print_comparison

    raise typer.Exit(print_comparison(run_a, run_b, folder))


@app.command(rich_help_panel=STORE)
def verify(home: Home = None) -> None:
    """Hash every artefact of the store again and set damaged ones aside, so that the next run makes them anew."""
    from flows.verify import verify_home

    raise typer.Exit(verify_home(_home(home)))


def _finite(value: float) -> float:
    if not math.isfinite(value):
        raise typer.BadParameter(f"must be a number of days, got {value}")
    return value


@app.command(rich_help_panel=STORE)
def prune(
    keep_days: Annotated[
        float, typer.Option(min=0, metavar="N", help="keep what was used in the last N days", callback=_finite)
    ] = 30,
    keep_versions: Annotated[
        int,
        typer.Option(
            min=0, metavar="N", help="keep the newest published versions of each experiment, and always the latest"
        ),
    ] = 5,
    apply: Annotated[bool, typer.Option("--apply", help="remove; without it, list what would be removed")] = False,
    home: Home = None,
) -> None:
    """Remove artefacts that no run has used lately; what the kept ones were made from stays."""
    from flows.prune import prune_home

    raise typer.Exit(prune_home(_home(home), keep_days, keep_versions, apply=apply))


def _home(home: str | None) -> Path:
    from data_contracts.home_folder import home_folder

    if home == "":  # of a variable that is not set; another home might be pruned
        raise typer.BadParameter("expected a folder or a URL, got ''", param_hint="--home")
    try:
        return home_folder(home)
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        raise typer.Exit(2) from None


@app.command(rich_help_panel=STORE)
def show(
    run: Annotated[
        str | None,
        typer.Argument(
            help="name, key or path of a report; the newest where none is named",
            autocompletion=_complete_report,
            show_default=False,
        ),
    ] = None,
    open_page: Annotated[
        bool | None,
        typer.Option("--open/--no-open", help="open it in a browser (default: on a terminal)", show_default=False),
    ] = None,
    home: Home = None,
) -> None:
    """Open the report of a run, and print its path."""
    from flows.show import show_report

    raise typer.Exit(show_report(run, _home(home), open_page=open_page))


@app.command(rich_help_panel=LOOK_UP)
def presets() -> None:
    """List the presets, a line each: what it does, and how long it takes."""
    from flows.preset_table import print_presets

    print_presets()


@app.command(rich_help_panel=LOOK_UP)
def options(
    name: Annotated[
        str,
        typer.Argument(
            metavar="PRESET|PLUGIN",
            help="a preset, or a plug-in such as `controlnet` or `datasets/folder`",
            show_default=False,
        ),
    ],
) -> None:
    """List every option of a preset or a plug-in: type, default, description."""
    from flows.option_list import print_options

    raise typer.Exit(print_options(name))


if __name__ == "__main__":
    main()
