"""The command `rcseg`: options in, one call, exit code out.

Exit codes: 0; 1 unexpected; 2 bad usage or input, one line on stderr; 130 interrupted, with what was finished
readable. Heavy modules are imported inside the commands, so that --help and completion answer at once.
"""

import os
import sys
from collections.abc import Sequence
from enum import Enum
from pathlib import Path
from typing import Annotated, Any, Optional

import typer

from rcseg_ros.commands import completion
from rcseg_ros.commands.signals import taking_signals
from rcseg_ros.frames.reading import DEFAULT_READING

app = typer.Typer(
    name="rcseg",
    no_args_is_help=True,
    rich_markup_mode="markdown",
    pretty_exceptions_enable=False,
    help="Segment registered range and colour images into Bezier patches (Boulanger's Bayesian method).",
    epilog="Start with: `rcseg replay RECORDING -o OUT --overlays`",
)

INTERRUPTED = 130

# What OpenCV finds wrong with a picture stands in our own line.
os.environ.setdefault("OPENCV_LOG_LEVEL", "ERROR")


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
    typer.Option(
        "--set",
        "-s",
        metavar="KEY=VALUE",
        help="One parameter; may be given several times.",
        autocompletion=completion.parameters,
    ),
]
Force = Annotated[bool, typer.Option("--force", "-f", help="Replace an earlier result of rcseg there.")]
Output = Annotated[
    Optional[Path],  # noqa: UP045
    typer.Option("--output", "-o", help="Folder to write; by default NAME_rcseg in this folder."),
]

Up = Annotated[
    str,
    typer.Option(
        "--up", metavar="WHAT", show_default=False,
        help="Which way is up: tf:FRAME (its z axis), imu, imu:TOPIC, X,Y,Z (in the sensor's frame), floor.",
        autocompletion=completion.one_of(completion.UP),
    ),
]  # fmt: skip
RangeFrom = Annotated[
    str, typer.Option(help="auto, points or depth.", autocompletion=completion.one_of(completion.RANGE_FROM))
]
Images = Annotated[
    str,
    typer.Option(
        help="raw or rectified, where topics do not tell; auto.",
        autocompletion=completion.one_of(completion.IMAGES),
    ),
]
Families = Annotated[
    str,
    typer.Option(
        help="Synthetic families, separated by commas.",
        autocompletion=completion.some_of(completion.families),
    ),
]
DepthUnit = Annotated[
    float,
    typer.Option("--depth-unit", min=0, help="Metres of one unit of depth; 0: mm of whole numbers, else m."),
]
MaxDepth = Annotated[
    float,
    typer.Option(
        "--max-depth", min=0.001, help="Refuse frames whose median depth is beyond, m: a wrong unit."
    ),
]

ColorBits = Annotated[
    int, typer.Option(min=0, max=16, help="Bits used in 16-bit images; 0: as the brightest pixel needs.")
]
AssumeRegistered = Annotated[
    bool, typer.Option("--assume-registered", help="Range and colour pair pixel by pixel in any frames.")
]
Slop = Annotated[float, typer.Option(min=0, help="Largest difference of stamps in a pair, ms.")]
Topics = Annotated[
    Optional[list[str]],  # noqa: UP045
    typer.Option(
        metavar="KEY=TOPIC",
        autocompletion=completion.one_of(completion.TOPIC_KEYS),
        help="As of `rcseg replay`.",
    ),
]


@app.command(epilog="Example: `rcseg replay drive.mcap -o drive_regions --overlays --set grouping.max_gap=2`")
def replay(
    bag: Annotated[Path, typer.Argument(help="rosbag2 folder, .mcap or .db3 file.", show_default=False)],
    output: Output = None,
    preset: Presets = None,
    config: ConfigFile = None,
    set_: Settings = None,
    topics: Annotated[
        Optional[list[str]],  # noqa: UP045
        typer.Option(
            metavar="KEY=TOPIC",
            autocompletion=completion.one_of(completion.TOPIC_KEYS),
            help="range=, color=, camera_info= or range_camera_info= (of a depth image of another camera), "
            "several separated by commas; KEY=none does without.",
        ),
    ] = None,
    range_from: RangeFrom = "auto",
    depth_unit: DepthUnit = DEFAULT_READING.depth_unit_m,
    max_depth: MaxDepth = DEFAULT_READING.max_depth_m,
    color_bits: ColorBits = DEFAULT_READING.color_bits,
    images: Images = "auto",
    assume_registered: AssumeRegistered = False,
    extrinsic: Annotated[
        str,
        typer.Option(
            metavar="X,Y,Z,QX,QY,QZ,QW",
            help="Where the range's frame stands in the colour image's: metres, quaternion.",
        ),
    ] = "",
    up: Up = "",
    slop: Slop = 20.0,
    outputs: Annotated[
        str,
        typer.Option(
            help="What to write, separated by commas; usual: all but clouds of points.",
            autocompletion=completion.some_of(completion.outputs),
        ),
    ] = "usual",
    track_labels: Annotated[
        bool, typer.Option("--track-labels", help="Label images hold ids of tracks in place of labels.")
    ] = False,
    fixed_frame: Annotated[
        str,
        typer.Option(help="Frame in which /tf tells the sensor's pose, for tracks; else nav_msgs/Odometry."),
    ] = "",
    overlays: Annotated[bool, typer.Option("--overlays", help="Write a PNG of each frame too.")] = False,
    tables: Annotated[
        bool, typer.Option("--tables", help="Write Parquet tables of frames, surfaces, regions, labels too.")
    ] = False,
    force: Force = False,
    workers: Annotated[
        Optional[int],  # noqa: UP045
        typer.Option(
            min=1, max=64, help="Frames that are segmented at once; by default as many as processors."
        ),
    ] = None,
    max_frames: Annotated[Optional[int], typer.Option(min=1, help="Stop after so many.")] = None,  # noqa: UP045
    verbose: Annotated[
        bool, typer.Option("--verbose", "-v", help="List every topic, and why it is taken or not.")
    ] = False,
) -> None:
    """Segment a recording: a result bag, metrics.json, config.yaml and a table."""
    from rcseg_ros.commands.replay import ReplayRequest
    from rcseg_ros.commands.terminal import run_replay
    from rcseg_ros.frames.reading import Reading
    from rcseg_ros.frames.registration import Surroundings
    from rcseg_ros.recordings.up import parse_up
    from rcseg_ros.settings import load_config

    named = _parse_topics(topics or ())
    settings, told = parse_up(up, load_config(config, set_ or (), preset))
    request = ReplayRequest(
        bag=bag,
        output=output or Path(f"{bag.absolute().stem}_rcseg"),
        config=settings,
        up=told,
        topics=named,
        range_from=_choice("--range-from", range_from, completion.RANGE_FROM),
        slop_ns=round(slop * 1e6),
        outputs=_parse_outputs(outputs),
        overlays=overlays,
        tables=tables,
        force=force,
        workers=workers or 0,
        max_frames=max_frames,
        reading=Reading(depth_unit, max_depth, color_bits),
        around=Surroundings(
            images=_choice("--images", images, completion.IMAGES),
            assume_registered=assume_registered,
            extrinsic=_parse_extrinsic(extrinsic),
            prefer_image="color" in named,
        ),
        track_labels=track_labels,
        fixed_frame=fixed_frame,
    )
    raise typer.Exit(run_replay(request, verbose))


@app.command(
    epilog="Examples: `rcseg batch recordings/ -o OUT`, again with more; "
    "`rcseg batch list.txt -o OUT --shard 3/20`"
)
def batch(
    inputs: Annotated[
        list[str],
        typer.Argument(
            metavar="INPUT...",
            help="Recordings, folders of such, patterns, URLs, or .txt files with one of these a line.",
            show_default=False,
        ),
    ],
    output: Annotated[
        Path, typer.Option("--output", "-o", help="Folder of the run; given again, it goes on.")
    ],
    preset: Presets = None,
    config: ConfigFile = None,
    set_: Settings = None,
    runner: Annotated[
        str,
        typer.Option(
            help="local: processes of this machine; ray: a cluster.",
            autocompletion=completion.one_of(completion.RUNNERS),
        ),
    ] = "local",
    address: Annotated[
        str, typer.Option(help="Of the Ray cluster, as ray.init takes it; without one, of this machine.")
    ] = "",
    workers: Annotated[
        int, typer.Option(min=0, max=100_000, help="Units at a time; 0: one for each processor.")
    ] = 0,
    memory: Annotated[
        int, typer.Option(min=0, help="Most that a worker may allocate, MB; what Ray sets aside. 0: any.")
    ] = 2000,
    cpus: Annotated[float, typer.Option(min=0.01, help="Processors that Ray sets aside for a unit.")] = 1.0,
    retries: Annotated[int, typer.Option(min=0, help="How often a unit that failed is tried again.")] = 1,
    chunk: Annotated[
        float, typer.Option(min=0, help="Longest unit, s, of recordings with an index; 0: never cut one.")
    ] = 120.0,
    shard: Annotated[
        str, typer.Option(metavar="I/N", help="Only every N-th unit, from the I-th on: for job arrays.")
    ] = "1/1",
    tracks: Annotated[
        bool,
        typer.Option("--tracks", help="Tables in which surfaces, regions, objects keep their names."),
    ] = False,
    bags: Annotated[bool, typer.Option("--bags", help="Write a result bag of each unit too.")] = False,
    outputs: Annotated[
        str,
        typer.Option(
            help="What is in the bags, separated by commas.",
            autocompletion=completion.some_of(completion.outputs),
        ),
    ] = "usual",
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Say what there is to do, and do nothing.")
    ] = False,
    topics: Topics = None,
    range_from: RangeFrom = "auto",
    depth_unit: DepthUnit = DEFAULT_READING.depth_unit_m,
    max_depth: MaxDepth = DEFAULT_READING.max_depth_m,
    color_bits: ColorBits = DEFAULT_READING.color_bits,
    images: Images = "auto",
    assume_registered: AssumeRegistered = False,
    extrinsic: Annotated[
        str, typer.Option(metavar="X,Y,Z,QX,QY,QZ,QW", help="As of `rcseg replay`: metres, quaternion.")
    ] = "",
    up: Up = "",
    slop: Slop = 20.0,
) -> None:
    """Segment many recordings: Parquet tables, resumed where it stopped. Exit code 3: some units failed."""
    from rcseg_ros.tables.extras import need_pyarrow

    need_pyarrow()
    from rcseg_ros.batch.options import BatchOptions
    from rcseg_ros.batch.report import Runners, run_batch_command
    from rcseg_ros.batch.run import BatchRequest
    from rcseg_ros.frames.reading import Reading
    from rcseg_ros.recordings.up import parse_up
    from rcseg_ros.settings import load_config

    matrix = _parse_extrinsic(extrinsic)
    settings, told = parse_up(up, load_config(config, set_ or (), preset))
    options = BatchOptions(
        config=settings,
        topics=tuple(_parse_topics(topics or ()).items()),
        range_from=_choice("--range-from", range_from, completion.RANGE_FROM),
        slop_ns=round(slop * 1e6),
        reading=Reading(depth_unit, max_depth, color_bits),
        images=_choice("--images", images, completion.IMAGES),
        assume_registered=assume_registered,
        extrinsic=() if matrix is None else tuple(matrix.ravel().tolist()),
        up=told,
        tracks=tracks,
        bags=bags,
        outputs=_parse_outputs(outputs),
        chunk_s=chunk,
    )
    request = BatchRequest(tuple(inputs), output, options, retries, _parse_shard(shard))
    kind = _choice("--runner", runner, completion.RUNNERS)
    raise typer.Exit(run_batch_command(request, Runners(kind, address, workers, cpus, memory), dry_run))


@app.command(
    epilog="Example: `rcseg calibrate wall.mcap -o sensor.yaml`, then `rcseg replay BAG --config sensor.yaml`"
)
def calibrate(
    bag: Annotated[Path, typer.Argument(help="rosbag2 folder, .mcap or .db3 file.", show_default=False)],
    output: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option(
            "--output", "-o", help="File to write, a picture beside it; by default NAME_sensor.yaml here."
        ),
    ] = None,
    topics: Topics = None,
    range_from: RangeFrom = "auto",
    depth_unit: DepthUnit = DEFAULT_READING.depth_unit_m,
    max_depth: MaxDepth = DEFAULT_READING.max_depth_m,
    images: Images = "auto",
    assume_registered: AssumeRegistered = False,
    extrinsic: Annotated[
        str, typer.Option(metavar="X,Y,Z,QX,QY,QZ,QW", help="As of `rcseg replay`: metres, quaternion.")
    ] = "",
    slop: Slop = 20.0,
    max_frames: Annotated[int, typer.Option(min=1, help="Stop after so many.")] = 100,
    force: Annotated[bool, typer.Option("--force", "-f", help="Overwrite the file and the picture.")] = False,
) -> None:
    """Measure the range error of a sensor on planes: a file for --config, a table, a picture."""
    from rcseg_ros.commands.calibrate import CalibrateRequest
    from rcseg_ros.commands.terminal import run_calibrate
    from rcseg_ros.frames.reading import Reading
    from rcseg_ros.frames.registration import Surroundings

    named = _parse_topics(topics or ())
    request = CalibrateRequest(
        bag=bag,
        output=output or Path(f"{bag.absolute().stem}_sensor.yaml"),
        topics=named,
        range_from=_choice("--range-from", range_from, completion.RANGE_FROM),
        slop_ns=round(slop * 1e6),
        max_frames=max_frames,
        force=force,
        reading=Reading(depth_unit, max_depth, DEFAULT_READING.color_bits),
        around=Surroundings(
            images=_choice("--images", images, completion.IMAGES),
            assume_registered=assume_registered,
            extrinsic=_parse_extrinsic(extrinsic),
            prefer_image="color" in named,
        ),
    )
    raise typer.Exit(run_calibrate(request))


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
    depth_unit: DepthUnit = DEFAULT_READING.depth_unit_m,
    max_depth: MaxDepth = DEFAULT_READING.max_depth_m,
    output: Output = None,
    preset: Presets = None,
    config: ConfigFile = None,
    set_: Settings = None,
    force: Force = False,
) -> None:
    """Segment one frame: labels.png (16 bit), surface_labels.png, overlay.png, regions.json."""
    from rcseg_ros.commands.segment_one import read_images, read_npz, segment_to_folder
    from rcseg_ros.commands.terminal import prepare, print_regions
    from rcseg_ros.frames.reading import Reading
    from rcseg_ros.settings import load_config

    settings, reading = load_config(config, set_ or (), preset), Reading(depth_unit, max_depth)
    if frame is not None and color is None and depth is None:
        data, name = read_npz(frame, reading), frame.stem
    elif frame is None and color is not None and depth is not None and intrinsics:
        data, name = read_images(color, depth, intrinsics, reading), color.stem
    else:
        raise _bad_input("segment: give either FRAME.npz, or --color, --depth and --intrinsics together")
    folder = output or Path(f"{name}_rcseg")
    print_regions(segment_to_folder(data, settings, folder, force, prepare), folder)


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
    from rcseg_ros.commands.terminal import print_config
    from rcseg_ros.settings import config_yaml, load_config

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
    families: Families = "all",
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
            help="What is judged: regions, surfaces, both or objects; auto: regions of scenes, both of data.",
            autocompletion=completion.one_of(completion.LEVELS),
        ),
    ] = "auto",
    planes: Annotated[
        bool,
        typer.Option("--planes", help="Judge recognised planes by the rules of EVOPS (IoU .75)."),
    ] = False,
    uncertainty: Annotated[
        bool,
        typer.Option("--uncertainty", help="Compare stated errors with the truth of synthetic scenes."),
    ] = False,
    tracks: Annotated[
        bool,
        typer.Option("--tracks", help="Judge names over time: `synthetic` journeys, or frames in order."),
    ] = False,
    frames: Annotated[int, typer.Option(min=1, help="With --tracks, frames of a journey.")] = 60,
    poses: Annotated[
        str,
        typer.Option(
            help="With --tracks: exact, noisy, none or all.",
            autocompletion=completion.some_of(completion.poses),
        ),
    ] = "all",
    still: Annotated[bool, typer.Option("--still", help="With --tracks: nothing moves.")] = False,
    depth_unit: DepthUnit = DEFAULT_READING.depth_unit_m,
    max_depth: MaxDepth = DEFAULT_READING.max_depth_m,
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
    """Compare with truth: Hoover's classes, information, parts, planes, reconstruction; tables, pictures."""
    from rcseg_ros.commands.terminal import CONSOLE, prepare, report_faults
    from rcseg_ros.evaluation.evaluate import run_evaluate
    from rcseg_ros.evaluation.options import SyntheticOptions, parse_families, parse_seeds, parse_size
    from rcseg_ros.evaluation.references import read_reference
    from rcseg_ros.frames.reading import Reading
    from rcseg_ros.recordings.staging import check_place
    from rcseg_ros.settings import load_config

    settings = load_config(config, set_ or (), preset)
    if tracks:
        from rcseg_ros.evaluation.tracks import POSES, TrackOptions, run_evaluate_tracks

        words = POSES if poses == "all" else tuple(poses.split(","))
        run_evaluate_tracks(
            dataset,
            config=settings,
            console=CONSOLE,
            warm_up=prepare,
            output=None if tables_only else output or Path(f"{Path(dataset).absolute().stem}_tracks"),
            force=force,
            options=TrackOptions(parse_seeds(seeds), frames, *parse_size(size), words, still),
            match=match,
            reading=Reading(depth_unit, max_depth),
        )
        return
    file = check or write_reference
    if write_reference is not None:
        check_place(write_reference)
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
        planes=planes,
        uncertainty=uncertainty,
        reading=Reading(depth_unit, max_depth),
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
    families: Families = "room,blocks,curved",
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
    from rcseg_ros.bench.run import BenchOptions, parse_sizes, parse_threads
    from rcseg_ros.commands.terminal import run_bench
    from rcseg_ros.evaluation.options import parse_families, parse_seeds
    from rcseg_ros.settings import load_config

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
    from rcseg_ros.commands.terminal import run_warmup

    run_warmup()


@app.command(epilog="Example: `rcseg inspect demo --frame 0`")
def inspect(
    result: Annotated[Path, typer.Argument(help="Folder that `rcseg replay` wrote.", show_default=False)],
    frame: Annotated[Optional[int], typer.Option(min=0, help="Show the regions of this frame.")] = None,  # noqa: UP045
    track: Annotated[Optional[int], typer.Option(min=1, help="Show the life of this track.")] = None,  # noqa: UP045
) -> None:
    """Show what a result bag holds, frame by frame, region by region."""
    from rcseg_ros.commands.inspect import inspect_bag
    from rcseg_ros.commands.terminal import CONSOLE

    if track is not None:
        from rcseg_ros.commands.inspect_track import inspect_track

        inspect_track(result, track, CONSOLE)
        return
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
    up: Up = "",
    preset: Presets = None,
    config: ConfigFile = None,
    set_: Settings = None,
) -> None:
    """Show regions, labels and the reconstruction in a browser, or in Foxglove. Ctrl-C ends it."""
    from rcseg_ros.commands.terminal import run_view
    from rcseg_ros.commands.view import ViewRequest
    from rcseg_ros.recordings.up import parse_up
    from rcseg_ros.settings import load_config

    settings, told = parse_up(up, load_config(config, set_ or (), preset))
    request = ViewRequest(bag, settings, node, rate, loop=not once, up=told)
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


def _parse_shard(text: str) -> tuple[int, int]:
    first, slash, step = text.partition("/")
    if not slash or not (first.isdecimal() and step.isdecimal()) or not 1 <= int(first) <= int(step):
        raise _bad_input(f"--shard {text}: expected I/N with I from 1 to N, for example 3/20")
    return int(first), int(step)


def _parse_extrinsic(text: str) -> Any:
    import numpy as np

    from rcseg_ros.frames.extrinsic import rigid

    if not text:
        return None
    try:
        numbers = [float(number) for number in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) != 7 or not np.isfinite(numbers).all() or not any(numbers[3:]):
        raise _bad_input(
            f"--extrinsic {text}: expected X,Y,Z,QX,QY,QZ,QW, in metres and a quaternion that is not zero"
        )
    matrix = rigid(numbers[:3], numbers[3:])
    return np.eye(4) if matrix is None else matrix  # two sensors in one place, which was said


def _parse_outputs(text: str) -> tuple[str, ...]:
    from rcseg_ros.recordings.segmenting import CLOUDS, OUTPUTS

    known = {"all": (*OUTPUTS, *CLOUDS), "usual": OUTPUTS} | {name: (name,) for name in (*OUTPUTS, *CLOUDS)}
    names = [_choice("--outputs", name.strip(), list(known)) for name in text.split(",")]
    return tuple(dict.fromkeys(output for name in names for output in known[name]))


def _choice(option: str, value: str, choices: Sequence[str]) -> str:
    if value not in choices:
        raise _bad_input(f"{option} {value}: expected one of {', '.join(choices)}")
    return value


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit code."""
    with taking_signals():
        return _run(arguments)


def _run(arguments: Sequence[str] | None) -> int:
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
