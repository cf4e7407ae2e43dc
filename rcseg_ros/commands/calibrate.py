"""`rcseg calibrate`: the range error of a sensor from a recording, as a file of parameters and a picture.

The frames come through the same pairing and conversions as those of `rcseg replay`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from itertools import islice
from pathlib import Path

from rcseg_core import RangeColorFrame
from rcseg_core.calibration import Calibration, calibrate
from rcseg_core.config import SegmenterConfig, describe
from rcseg_core.errors import InputError
from rcseg_ros.commands.calibration_picture import write_picture
from rcseg_ros.commands.replay import Interrupt
from rcseg_ros.frames.assembly import assemble
from rcseg_ros.frames.extrinsic import recorded_transforms
from rcseg_ros.frames.reading import DEFAULT_READING, Reading
from rcseg_ros.frames.registration import Surroundings
from rcseg_ros.frames.sync import FrameSync, Pair, explain_gap
from rcseg_ros.options import yaml_value
from rcseg_ros.recordings.bag import Recording
from rcseg_ros.recordings.staging import check_place
from rcseg_ros.recordings.topics import InputTopics, find_topics


@dataclass(frozen=True)
class CalibrateRequest:
    """What to measure, and how it is read; the options of `rcseg calibrate`."""

    bag: Path
    output: Path
    topics: Mapping[str, str] = field(default_factory=dict)
    range_from: str = "auto"
    slop_ns: int = 20_000_000
    max_frames: int = 100
    force: bool = False
    reading: Reading = DEFAULT_READING
    around: Surroundings = field(default_factory=Surroundings)

    @property
    def picture(self) -> Path:
        return self.output.with_suffix(".png")


@dataclass(frozen=True)
class Calibrated:
    """What a run found and wrote."""

    found: Calibration
    inputs: InputTopics
    unusable: int
    first_error: str
    damage: list[str]
    interrupted: bool


def calibrate_recording(
    request: CalibrateRequest,
    on_frame: Callable[[int, int], None] = lambda done, total: None,
    prepare: Callable[[], object] = lambda: None,
) -> Calibrated | None:
    """Measure a recording; write the file and, beside it, the picture.

    After an interrupt the frames that were read count; None where there was none yet.

    Parameters
    ----------
    on_frame : called with the number of frames done and expected, as it goes
    prepare : called when input and output are known to be of use, before the first frame

    Raises
    ------
    InputError
        Unusable recording, topics or output, no usable frame, or no plane in any. Nothing is written then.
    """
    _check_output(request)
    interrupt = Interrupt()
    with Recording(request.bag) as recording, ExitStack() as stack:
        inputs = find_topics(recording, request.topics, request.range_from)
        total = min(recording.topics[inputs.range].count, request.max_frames)
        reader = _Reader(request, recording, inputs, interrupt)
        prepare()
        stack.enter_context(interrupt.armed())
        try:
            found = calibrate(reader.frames(lambda done: on_frame(done, total)))
        except InputError as error:
            if interrupt.requested:
                return None
            why = reader.first_error or "; ".join(recording.damage) or reader.gap()
            raise InputError(f"{request.bag}: {error}{f'; {why}' if why else ''}") from None
        result = Calibrated(
            found, inputs, reader.unusable, reader.first_error, recording.damage, interrupt.requested
        )
    _write(request, found)
    return result


def _check_output(request: CalibrateRequest) -> None:
    """Say before the work what would keep it from being written."""
    if request.output.suffix not in (".yaml", ".yml"):
        raise InputError(f"{request.output}: name a file that ends in .yaml")
    check_place(request.output)
    for path in (request.output, request.picture):
        if path.is_dir():
            raise InputError(f"{path}: is a folder; name another file")
        if path.exists() and not request.force:
            raise InputError(f"{path}: exists already; name another file, or overwrite it with --force")


class _Reader:
    """The usable frames of a recording, and why there were no more."""

    def __init__(
        self, request: CalibrateRequest, recording: Recording, inputs: InputTopics, interrupt: Interrupt
    ) -> None:
        self._request, self._recording, self._inputs = request, recording, inputs
        self._interrupt = interrupt
        self.unusable = 0
        self.first_error = ""

    def frames(self, on_frame: Callable[[int], None]) -> Iterator[RangeColorFrame]:
        recording, inputs = self._recording, self._inputs
        around = replace(
            self._request.around,
            range_topic=inputs.range,
            color_topic=inputs.color or "",
            transforms=recorded_transforms(recording, inputs.range, inputs.color),
        )
        for done, pair in enumerate(islice(self._pairs(), self._request.max_frames)):
            if self._interrupt.requested:
                return
            raws = (pair.range, pair.color, pair.camera, pair.range_camera)
            try:
                messages = [None if raw is None else recording.decode(raw) for raw in raws]
                frame = assemble(*messages, around, self._request.reading).frame
            except InputError as error:
                self.unusable += 1
                self.first_error = self.first_error or str(error)
                continue
            yield frame
            on_frame(done + 1)

    def _pairs(self) -> Iterator[Pair]:
        recording, inputs = self._recording, self._inputs
        sync = FrameSync(
            slop_ns=self._request.slop_ns,
            queue_size=50,
            with_color=inputs.color is not None,
            needs_camera=inputs.camera_info is not None,
            needs_range_camera=lambda pair: inputs.range_camera_info is not None,
        )
        add = sync.by_topic(inputs.range, inputs.color, inputs.camera_info, inputs.range_camera_info)
        for info in (inputs.camera_info, inputs.range_camera_info):
            for raw in islice(recording.messages([info or ""]), 1):
                add[info](raw.stamp_ns, raw)  # one that was sent once holds for the frames before it too
        for raw in recording.messages(inputs.names()):
            yield from add[raw.topic](raw.stamp_ns, raw)
        yield from sync.flush()

    def gap(self) -> str:
        """By how much stamps of range and colour differ, where nothing met."""
        if self._inputs.color is None or next(self._pairs(), None) is not None:
            return ""
        stamps = [
            [raw.stamp_ns for raw in self._recording.messages([topic])]
            for topic in (self._inputs.range, self._inputs.color)
        ]
        return explain_gap(*stamps, self._request.slop_ns)


def sensor_yaml(found: Calibration, recording: str) -> str:
    """The text of a parameter file, for the node and for `--config`, with how it was measured in its head."""
    near, far = found.bins[0].depth_m, found.bins[-1].depth_m
    depths = f"{near:.2f} to {far:.2f} m" if len(found.bins) > 1 else f"{near:.2f} m"
    lines = [
        f"# Range error at {depths}, measured by `rcseg calibrate {recording}`:",
        f"# {found.how}.",
        *(
            ["# All is at about one depth: the law is that of stereo, constant in inverse depth."]
            if found.one_depth
            else []
        ),
        "/**:",
        "  ros__parameters:",
        "    noise:",
    ]
    known = {p.key: p for p in describe(SegmenterConfig())}
    for key, value in found.settings().items():
        unit = known[key].unit
        comment = f"  # {unit}" if unit else ""
        lines.append(f"      {key.removeprefix('noise.')}: {yaml_value(value)}{comment}")
    return "\n".join(lines) + "\n"


def _write(request: CalibrateRequest, found: Calibration) -> None:
    try:
        request.output.parent.mkdir(parents=True, exist_ok=True)
        write_picture(request.picture, found, request.bag.name)
        request.output.write_text(sensor_yaml(found, request.bag.name), "utf-8")
    except OSError as error:
        raise InputError(f"{error.filename or request.output}: cannot write: {error.strerror}") from None
