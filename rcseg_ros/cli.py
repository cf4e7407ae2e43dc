"""The command `rcseg`: options in, one call, exit code out.

Exit codes: 0; 1 unexpected; 2 bad usage or input, one line on stderr; 130 interrupted, with what was finished
readable. Heavy modules are imported inside the commands, so that --help and completion answer at once.
"""

import sys
from collections.abc import Sequence
from enum import Enum
from pathlib import Path
from typing import Annotated, Any, Optional

import typer

app = typer.Typer(
    name="rcseg",
    no_args_is_help=True,
    rich_markup_mode="markdown",
    pretty_exceptions_enable=False,
    help="Segment registered range and colour images into Bezier patches (Boulanger's Bayesian method).",
    epilog="Start with: `rcseg replay RECORDING -o OUT --overlays`",
)

INTERRUPTED = 130


class Preset(str, Enum):
    """Names of `rcseg_core.config.PRESETS`, written here again so that completion needs no import of it."""

    fast = "fast"
    balanced = "balanced"
    accurate = "accurate"


# Typer 0.9 (Ubuntu 24.04) reads neither "X | None" nor annotations that are postponed.
ConfigFile = Annotated[
    Optional[Path],  # noqa: UP045
    typer.Option("--config", "-c", help="YAML file of parameters (`rcseg config --yaml` writes one)."),
]
Presets = Annotated[
    Optional[Preset],  # noqa: UP045
    typer.Option("--preset", "-p", help="Speed against accuracy (balanced); --config and --set change it."),
]
Settings = Annotated[
    Optional[list[str]],  # noqa: UP045
    typer.Option("--set", "-s", metavar="KEY=VALUE", help="One parameter; may be given several times."),
]
Force = Annotated[bool, typer.Option("--force", "-f", help="Replace an earlier result of rcseg there.")]
Output = Annotated[
    Optional[Path],  # noqa: UP045
    typer.Option("--output", "-o", help="Folder to write; by default NAME_rcseg in this folder."),
]


@app.command(epilog="Example: `rcseg replay drive.mcap -o drive_regions --overlays --set grouping.max_gap=2`")
def replay(
    bag: Annotated[Path, typer.Argument(help=".mcap file or rosbag2 folder.", show_default=False)],
    output: Output = None,
    preset: Presets = None,
    config: ConfigFile = None,
    set_: Settings = None,
    topics: Annotated[
        Optional[list[str]],  # noqa: UP045
        typer.Option(
            metavar="KEY=TOPIC",
            help="range=, color= or camera_info=, several separated by commas; KEY=none does without.",
        ),
    ] = None,
    range_from: Annotated[str, typer.Option(help="auto, points or depth.")] = "auto",
    slop: Annotated[float, typer.Option(min=0, help="Largest difference of stamps in a pair, ms.")] = 20.0,
    outputs: Annotated[str, typer.Option(help="What to write, separated by commas.")] = "all",
    overlays: Annotated[bool, typer.Option("--overlays", help="Write a PNG of each frame too.")] = False,
    force: Force = False,
    workers: Annotated[
        Optional[int],  # noqa: UP045
        typer.Option(
            min=1, max=64, help="Frames that are segmented at once; by default as many as processors."
        ),
    ] = None,
    max_frames: Annotated[Optional[int], typer.Option(min=1, help="Stop after so many.")] = None,  # noqa: UP045
) -> None:
    """Segment a recording: a result bag, metrics.json, config.yaml and a table."""
    from rcseg_ros.replay import ReplayRequest
    from rcseg_ros.settings import load_config
    from rcseg_ros.terminal import run_replay

    request = ReplayRequest(
        bag=bag,
        output=output or Path(f"{bag.absolute().stem}_rcseg"),
        config=load_config(config, set_ or (), preset),
        topics=_parse_topics(topics or ()),
        range_from=_choice("--range-from", range_from, ("auto", "points", "depth")),
        slop_ns=round(slop * 1e6),
        outputs=_parse_outputs(outputs),
        overlays=overlays,
        force=force,
        workers=workers or 0,
        max_frames=max_frames,
    )
    raise typer.Exit(run_replay(request))


@app.command(
    epilog="Examples: `rcseg segment frame.npz` or "
    "`rcseg segment --color rgb.png --depth depth.png --intrinsics 525,525,319.5,239.5`"
)
def segment(
    frame: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Argument(help=".npz with color and points (and K), or color, depth and K.", show_default=False),
    ] = None,
    color: Annotated[Optional[Path], typer.Option(help="Colour picture, 8 bit.")] = None,  # noqa: UP045
    depth: Annotated[Optional[Path], typer.Option(help="Depth picture, 16 bit, 0: none.")] = None,  # noqa: UP045
    intrinsics: Annotated[str, typer.Option(metavar="FX,FY,CX,CY", help="Camera, in pixels.")] = "",
    depth_unit: Annotated[float, typer.Option(min=1e-6, help="Metres of one step of depth.")] = 0.001,
    output: Output = None,
    preset: Presets = None,
    config: ConfigFile = None,
    set_: Settings = None,
    force: Force = False,
) -> None:
    """Segment one frame: labels.png (16 bit), surface_labels.png, overlay.png, regions.json."""
    from rcseg_ros.segment_one import read_images, read_npz, segment_to_folder
    from rcseg_ros.settings import load_config
    from rcseg_ros.terminal import prepare, print_regions

    settings = load_config(config, set_ or (), preset)
    if frame is not None and color is None and depth is None:
        data, name = read_npz(frame), frame.stem
    elif frame is None and color is not None and depth is not None and intrinsics:
        data, name = read_images(color, depth, intrinsics, depth_unit), color.stem
    else:
        raise _bad_input("segment: give either FRAME.npz, or --color, --depth and --intrinsics together")
    folder = output or Path(f"{name}_rcseg")
    prepare(settings)
    print_regions(segment_to_folder(data, settings, folder, force), folder)


@app.command(
    epilog="Example: `rcseg config --yaml my.yaml`, change it, then `rcseg replay BAG --config my.yaml`"
)
def config(
    yaml: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option(help="Write the parameters to this file instead; - for the screen."),
    ] = None,
    preset: Presets = None,
    config_file: ConfigFile = None,
    set_: Settings = None,
    force: Annotated[bool, typer.Option("--force", "-f", help="Overwrite the file.")] = False,
) -> None:
    """Print every parameter: value, default, unit, bounds, the paper's symbol."""
    from rcseg_ros.settings import config_yaml, load_config
    from rcseg_ros.terminal import print_config

    settings = load_config(config_file, set_ or (), preset)
    if yaml is None:
        print_config(settings)
    elif str(yaml) == "-":
        print(config_yaml(settings), end="")
    elif yaml.exists() and not force:
        raise _bad_input(f"{yaml}: exists already; name another file, or overwrite it with --force")
    else:
        try:
            yaml.write_text(config_yaml(settings), "utf-8")
        except OSError as error:
            raise _bad_input(f"{yaml}: cannot write: {error.strerror}") from None


@app.command(
    epilog="Examples: `rcseg evaluate synthetic --families room,blocks --seeds 100-109` or "
    "`rcseg evaluate DATA --match 'mosd_*' --labels surfaces`"
)
def evaluate(
    dataset: Annotated[
        str,
        typer.Argument(
            help="`synthetic`, or a frame, a recording, or a folder of such, mixed.", show_default=False
        ),
    ],
    output: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option("--output", "-o", help="Folder to write; by default NAME_evaluation in this folder."),
    ] = None,
    preset: Presets = None,
    config: ConfigFile = None,
    set_: Settings = None,
    families: Annotated[str, typer.Option(help="Synthetic families, separated by commas.")] = "all",
    seeds: Annotated[str, typer.Option(help="0-99 are for tuning, 100 and up for reports.")] = "100-109",
    size: Annotated[str, typer.Option(metavar="WIDTHxHEIGHT", help="Of synthetic frames.")] = "640x480",
    outliers: Annotated[float, typer.Option(min=0, max=1, help="Impulse noise, share by signal.")] = 0.0,
    dropout: Annotated[float, typer.Option(min=0, max=1, help="Share of pixels without range.")] = 0.0,
    structured_light: Annotated[
        bool, typer.Option("--structured-light", help="See synthetic frames as a Kinect would.")
    ] = False,
    match: Annotated[str, typer.Option(metavar="GLOB", help="Names of the recorded frames.")] = "*",
    labels: Annotated[
        str,
        typer.Option(
            help="What is judged: regions, surfaces or both; auto: regions of scenes, both of data."
        ),
    ] = "auto",
    tolerance: Annotated[float, typer.Option(help="Overlap of the tables, above 0.5.")] = 0.8,
    pictures: Annotated[bool, typer.Option(help="Write a sheet for each frame, and a page.")] = True,
    tables_only: Annotated[bool, typer.Option("--tables-only", help="Write no files.")] = False,
    check: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option(metavar="FILE", help="Compare with this reference; exit code 1 when worse."),
    ] = None,
    write_reference: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option(
            "--write-reference", metavar="FILE", help="Make, or renew, the reference with these figures."
        ),
    ] = None,
    force: Force = False,
) -> None:
    """Compare with truth: Hoover's classes, information, parts, reconstruction; tables, files, pictures."""
    from rcseg_ros.evaluate import run_evaluate
    from rcseg_ros.evaluate_options import SyntheticOptions, parse_families, parse_seeds, parse_size
    from rcseg_ros.references import read_reference
    from rcseg_ros.settings import load_config
    from rcseg_ros.terminal import CONSOLE, prepare, report_faults

    settings = load_config(config, set_ or (), preset)
    file = check or write_reference
    reference = read_reference(file) if file is not None and (check or file.exists()) else None
    folder = output or Path(f"{Path(dataset).absolute().stem}_evaluation")
    scenes = SyntheticOptions(
        parse_families(families, structured_light=structured_light),
        parse_seeds(seeds),
        *parse_size(size),
        outliers,
        dropout,
        structured_light,
    )
    report = run_evaluate(
        dataset,
        config=settings,
        console=CONSOLE,
        warm_up=prepare,
        output=None if tables_only else folder,
        force=force,
        synthetic=scenes,
        level=labels,
        tolerance=tolerance,
        match=match,
        pictures=pictures,
        reference=reference,
    )
    raise typer.Exit(report_faults(report, reference, check, write_reference))


@app.command(epilog="Examples: `rcseg bench -o bench` or `rcseg bench --frames FOLDER --threads all`")
def bench(
    frames: Annotated[
        Optional[list[str]],  # noqa: UP045
        typer.Option(
            metavar="SOURCE",
            help="`synthetic` (the default), a frame or a folder of frames; may be given several times.",
        ),
    ] = None,
    families: Annotated[str, typer.Option(help="Synthetic families, separated by commas.")] = (
        "room,blocks,curved"
    ),
    sizes: Annotated[str, typer.Option(metavar="WIDTHxHEIGHT,...", help="Of synthetic frames.")] = (
        "160x120,320x240,640x480,1280x960"
    ),
    seeds: Annotated[str, typer.Option(help="Of synthetic frames.")] = "100-102",
    match: Annotated[str, typer.Option(metavar="GLOB", help="Names of the recorded frames.")] = "*",
    repeat: Annotated[int, typer.Option(min=1, help="Rounds for each frame.")] = 7,
    threads: Annotated[str, typer.Option(help="1, all, or numbers separated by commas.")] = "1,all",
    peers: Annotated[bool, typer.Option(help="Run other segmenters too, where installed.")] = True,
    probe: Annotated[bool, typer.Option(help="Memory and first labels, in fresh processes.")] = True,
    cold: Annotated[
        bool, typer.Option("--cold", help="First labels with an empty cache too: a minute or two.")
    ] = False,
    presets: Annotated[
        bool,
        typer.Option("--presets", help="Compare the presets too: time, and accuracy on the seeds' scenes."),
    ] = False,
    output: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option("--output", "-o", help="Folder for bench.json, bench.csv and plots; without it none."),
    ] = None,
    preset: Presets = None,
    config: ConfigFile = None,
    set_: Settings = None,
    force: Force = False,
) -> None:
    """Measure speed by stage, memory and first labels, beside other segmenters in the same run."""
    from rcseg_ros.bench import BenchOptions, parse_sizes, parse_threads
    from rcseg_ros.evaluate_options import parse_families, parse_seeds
    from rcseg_ros.settings import load_config
    from rcseg_ros.terminal import run_bench

    options = BenchOptions(
        sources=tuple(frames or ("synthetic",)),
        families=parse_families(families),
        sizes=parse_sizes(sizes),
        seeds=parse_seeds(seeds),
        match=match,
        repeat=repeat,
        threads=parse_threads(threads),
        peers=peers,
        probe=probe or cold,
        cold=cold,
        presets={one.value: load_config(config, set_ or (), one) for one in Preset} if presets else {},
    )
    run_bench(options, load_config(config, set_ or (), preset), output, force)


@app.command(
    epilog="Example: `rcseg warmup` after an installation or an update, or while a container is built"
)
def warmup() -> None:
    """Compile all kernels now, and keep them: what starts later is ready within two seconds."""
    from rcseg_ros.terminal import run_warmup

    run_warmup()


@app.command(epilog="Example: `rcseg inspect demo --frame 0`")
def inspect(
    result: Annotated[Path, typer.Argument(help="Folder that `rcseg replay` wrote.", show_default=False)],
    frame: Annotated[Optional[int], typer.Option(min=0, help="Show the regions of this frame.")] = None,  # noqa: UP045
) -> None:
    """Show what a result bag holds, frame by frame, region by region."""
    from rcseg_ros.inspect import inspect_bag
    from rcseg_ros.terminal import CONSOLE

    inspect_bag(result, frame, CONSOLE)


@app.command(epilog="Example: `rcseg view bags/tabletop`, then open the address in a browser")
def view(
    bag: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Argument(
            help="Recording or result bag; without one the topics of a running node.", show_default=False
        ),
    ] = None,
    port: Annotated[int, typer.Option(min=0, max=65535, help="Of the page; 0: any free one.")] = 8080,
    foxglove: Annotated[
        Optional[int],  # noqa: UP045
        typer.Option(
            min=0, max=65535, help="Serve Foxglove and Lichtblick on this port too, for example 8765."
        ),
    ] = None,
    host: Annotated[
        str, typer.Option(help="Address to serve on; 0.0.0.0: for other machines.")
    ] = "127.0.0.1",
    rate: Annotated[
        float, typer.Option(min=0.01, max=1000, help="Most frames a second, of a recording.")
    ] = 2.0,
    once: Annotated[bool, typer.Option("--once", help="Do not begin again at the end.")] = False,
    node: Annotated[str, typer.Option(help="Name of the node, where its topics lie.")] = "/rcseg",
    preset: Presets = None,
    config: ConfigFile = None,
    set_: Settings = None,
) -> None:
    """Show regions, labels and the reconstruction in a browser, or in Foxglove. Ctrl-C ends it."""
    from rcseg_ros.settings import load_config
    from rcseg_ros.terminal import run_view
    from rcseg_ros.view import ViewRequest

    request = ViewRequest(bag, load_config(config, set_ or (), preset), node, rate, loop=not once)
    raise typer.Exit(run_view(request, host, port, foxglove))


def _bad_input(text: str) -> Exception:
    from rcseg_core.errors import InputError

    return InputError(text)


def _parse_topics(items: Sequence[str]) -> dict[str, str]:
    named = {}
    for item in (part for entry in items for part in entry.split(",")):
        key, equals, topic = item.partition("=")
        if not equals or not topic:
            raise _bad_input(f"--topics {item}: expected KEY=TOPIC, for example color=/camera/image_raw")
        named[key.strip()] = topic.strip()
    return named


def _parse_outputs(text: str) -> tuple[str, ...]:
    from rcseg_ros.segmenting import OUTPUTS

    if text == "all":
        return OUTPUTS
    return tuple(_choice("--outputs", name.strip(), OUTPUTS) for name in text.split(","))


def _choice(option: str, value: str, choices: Sequence[str]) -> str:
    if value not in choices:
        raise _bad_input(f"{option} {value}: expected one of {', '.join(choices)}")
    return value


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit code."""
    try:
        code = app(args=arguments, prog_name="rcseg", standalone_mode=False)
    except (KeyboardInterrupt, typer.Abort):
        code = INTERRUPTED  # typer's newer versions return it, older ones raise
    except BrokenPipeError:
        sys.stderr.close()  # the reader of our output has gone; Python would complain of it at exit
        return 0
    except Exception as error:
        from rcseg_core.errors import RcsegError

        usage: Any = error  # click's usage errors, whichever copy of click typer brings
        if hasattr(error, "format_message"):
            return _refuse(f"{usage.format_message()} (`rcseg --help` tells more)")
        if isinstance(error, RcsegError):
            return _refuse(str(error))
        raise
    if code == INTERRUPTED:
        print("rcseg: interrupted", file=sys.stderr)
    return code if isinstance(code, int) else 0


def _refuse(text: str) -> int:
    print("rcseg: " + " ".join(text.split()), file=sys.stderr)
    return 2


if __name__ == "__main__":
    sys.exit(main())
