"""How a run reads and segments, as plain values that travel to other processes and machines."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from hashlib import blake2b
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np

from rcseg_core import SegmenterConfig
from rcseg_core.errors import InputError
from rcseg_ros.batch.manifest import Cutting
from rcseg_ros.commands.replay import ReplayRequest
from rcseg_ros.frames.reading import DEFAULT_READING, Reading
from rcseg_ros.frames.registration import Surroundings
from rcseg_ros.recordings.segmenting import OUTPUTS, TRACKS
from rcseg_ros.recordings.storage import Span
from rcseg_ros.recordings.up import UpRequest
from rcseg_ros.tables.schema import VERSION

BATCH = "batch.json"


@dataclass(frozen=True)
class BatchOptions:
    """What decides on the results of a run; a folder holds results of one such only.

    Attributes
    ----------
    bags : write a result bag of each unit too, with `outputs` in it
    chunk_s : longest time that a unit covers, where the recording's index allows to cut it; 0: never cut
    tracks : name surfaces, regions and objects from frame to frame; recordings are never cut then
    extrinsic : 16 numbers of a (4, 4) transform, row by row, or none
    """

    config: SegmenterConfig = field(default_factory=SegmenterConfig)
    topics: tuple[tuple[str, str], ...] = ()
    range_from: str = "auto"
    slop_ns: int = 20_000_000
    reading: Reading = DEFAULT_READING
    images: str = "auto"
    assume_registered: bool = False
    extrinsic: tuple[float, ...] = ()
    up: UpRequest = field(default_factory=UpRequest)
    bags: bool = False
    outputs: tuple[str, ...] = OUTPUTS
    chunk_s: float = 120.0
    tracks: bool = False

    @property
    def cutting(self) -> Cutting:
        return Cutting(0.0 if self.tracks else self.chunk_s, self.topics, self.range_from)

    def request(self, recording: Path, folder: Path, span: Span) -> ReplayRequest:
        """The replay of a part of a recording by one thread."""
        topics = dict(self.topics)
        extrinsic = np.array(self.extrinsic).reshape(4, 4) if self.extrinsic else None
        around = Surroundings(
            images=self.images,
            assume_registered=self.assume_registered,
            extrinsic=extrinsic,
            prefer_image="color" in topics,
        )
        return ReplayRequest(
            recording,
            folder,
            self.config,
            topics=topics,
            range_from=self.range_from,
            slop_ns=self.slop_ns,
            outputs=self._outputs,
            workers=1,
            reading=self.reading,
            around=around,
            up=self.up,
            tables=True,
            tracks=self.tracks,
            span=span,
            threads=1,
        )

    @property
    def _outputs(self) -> tuple[str, ...]:
        """Of parts of a recording names would end with the part, so they are written where none is cut."""
        return tuple(one for one in self.outputs if self.bags and (self.tracks or one != TRACKS))

    def document(self) -> dict[str, Any]:
        """All of it as plain values, with the versions of rcseg and of the tables."""
        values = asdict(replace(self, config=None)) | {"config": self.config.to_dict(), "tables": VERSION}
        values["outputs"] = self._outputs
        plain: dict[str, Any] = json.loads(json.dumps(values))
        return {"rcseg": rcseg_version()} | plain


def rcseg_version() -> str:
    """Version of this installation; empty for sources that are not installed."""
    try:
        return version("rcseg")
    except PackageNotFoundError:
        return ""


def digest_of(document: Mapping[str, Any]) -> str:
    """Digest of plain values, 16 hexadecimal digits."""
    return blake2b(json.dumps(document, sort_keys=True).encode(), digest_size=8).hexdigest()


def check_same(folder: Path, document: Mapping[str, Any]) -> bool:
    """Whether a folder holds results of these options already.

    Returns
    -------
    bool : False where there is no run in it yet

    Raises
    ------
    InputError
        If it holds something else; the words name what differs.
    """
    if folder.exists() and not folder.is_dir():
        raise InputError(f"{folder}: is a file; name a folder")
    file = folder / BATCH
    if not file.exists():
        if folder.is_dir() and any(not one.name.startswith(".") for one in folder.iterdir()):
            raise InputError(f"{folder}: exists and is no run of `rcseg batch`; name another folder")
        return False
    try:
        earlier = json.loads(file.read_text("utf-8"))
        earlier.pop("digest")
    except (OSError, ValueError, KeyError, AttributeError, TypeError, RecursionError) as error:
        raise InputError(
            f"{file}: cannot be read: {' '.join(str(error).split())}; name another folder"
        ) from None
    changes = sorted(_changes(earlier, document))
    if changes:
        more = f" and {len(changes) - 3} more" if len(changes) > 3 else ""
        raise InputError(
            f"{folder}: holds a run with other options: {'; '.join(changes[:3])}{more}; give the same again, "
            "or name another folder"
        )
    return True


def _changes(old: Any, new: Any, key: str = "") -> list[str]:
    if isinstance(old, dict) and isinstance(new, dict):
        return [
            change
            for name in {*old, *new}
            for change in _changes(old.get(name), new.get(name), f"{key}.{name}" if key else name)
        ]
    return [] if old == new else [f"{key.removeprefix('config.')} was {_short(old)}, is {_short(new)}"]


def _short(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) <= 40 else text[:37] + "..."
