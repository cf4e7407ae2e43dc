"""Where `rcseg view` shows results: a page for any browser, and a WebSocket server for Foxglove and
Lichtblick.

Both are fed with the serialised messages that the node publishes, so what is shown is what a robot
receives. The page needs nothing but this package; the WebSocket server needs foxglove-sdk.
"""

from __future__ import annotations

import json
import re
import sys
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rcseg_core.errors import InputError
from rcseg_core.result.drawing import label_colors, labels_picture
from rcseg_core.world import CATEGORIES
from rcseg_ros.frames.conversions import decode_cloud, decode_image, decode_labels
from rcseg_ros.recordings.result_bag import definition_text, result_types
from rcseg_ros.recordings.segmenting import Output
from rcseg_ros.results.colors import CATEGORY_COLORS
from rcseg_ros.results.markers import SHAPES, box_edges, surface_drawings

CLIENT_TIMEOUT_S = 10.0
MOST_NUMBERS = 65535  # colours of tracks begin anew then, as in 16-bit label images
MOST_CLIENTS = 512  # each is let go after a while; a browser opens six connections
SECURITY_HEADERS = {
    "Cache-Control": "no-store",
    "Content-Security-Policy": "default-src 'self'; script-src 'self' 'unsafe-inline'; "
    "style-src 'self' 'unsafe-inline'; img-src 'self' blob: data:; frame-ancestors 'none'; base-uri 'none'",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
}
_LOOPBACK = re.compile(r"(localhost|127(\.\d{1,3}){3}|\[?::1\]?)(:\d+)?")
PAGE = Path(__file__).parent / "page.html"


@dataclass(frozen=True)
class Shown:
    """All outputs of one frame, serialised."""

    stamp_ns: int
    outputs: tuple[Output, ...]


class FoxgloveViewer:
    """WebSocket server; the messages pass through as they are, with their ROS definitions.

    Raises
    ------
    InputError
        foxglove-sdk is not installed, or the port is taken.
    """

    def __init__(self, host: str, port: int, namespace: str) -> None:
        try:
            import foxglove
        except ImportError as error:
            raise InputError(
                "view: Foxglove needs `pip install foxglove-sdk`; or leave --foxglove out"
            ) from error
        self._foxglove = foxglove
        self._namespace = namespace
        self._channels: dict[str, Any] = {}
        try:
            self._server = foxglove.start_server(name="rcseg", host=host, port=port)
        except Exception as error:
            raise InputError(f"view: cannot serve Foxglove on {host}:{port}: {error}") from error
        self.address = f"ws://{host}:{self._server.port}"

    def show(self, frame: Shown) -> None:
        for output in frame.outputs:
            if output.topic not in self._channels:
                schema = self._foxglove.Schema(
                    name=output.type, encoding="ros2msg", data=definition_text(output.type).encode()
                )
                self._channels[output.topic] = self._foxglove.Channel(
                    f"{self._namespace}/{output.topic}", message_encoding="cdr", schema=schema
                )
            self._channels[output.topic].log(bytes(output.data), log_time=frame.stamp_ns)

    def close(self) -> None:
        self._server.stop()


class _Server(ThreadingHTTPServer):
    """Says nothing of clients that go away or stall, and serves no more than MOST_CLIENTS at a time."""

    daemon_threads = True
    request_queue_size = 128

    def __init__(self, *arguments: Any) -> None:
        self._places = threading.BoundedSemaphore(MOST_CLIENTS)
        super().__init__(*arguments)

    def process_request(self, request: Any, client_address: Any) -> None:
        if not self._places.acquire(blocking=False):
            return self.shutdown_request(request)
        try:
            super().process_request(request, client_address)
        except RuntimeError:  # no thread could be started, so none gives the place back
            self._places.release()
            self.shutdown_request(request)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._places.release()

    def handle_error(self, request: Any, client_address: Any) -> None:
        if not isinstance(sys.exc_info()[1], OSError):
            super().handle_error(request, client_address)


class PageViewer:
    """A page with the overlay, the labels, the reconstruction with boxes in 3D, and the table of regions.

    Raises
    ------
    InputError
        The port is taken.
    """

    def __init__(self, host: str, port: int) -> None:
        self._lock = threading.Lock()
        self._parts: dict[str, tuple[str, bytes]] = {}
        self._count = 0
        self._labels: tuple[int, Any] = (-1, None)
        viewer = self

        class Handler(BaseHTTPRequestHandler):
            timeout = CLIENT_TIMEOUT_S  # of each read and write: a client that stalls is let go

            def do_GET(self) -> None:
                viewer._answer(self)

            def log_message(self, *_: Any) -> None:
                pass  # a line a request would bury what matters

        try:
            self._server = _Server((host, port), Handler)
        except OSError as error:
            raise InputError(
                f"view: cannot serve the page on {host}:{port}: {error.strerror}; try --port"
            ) from error
        threading.Thread(target=self._server.serve_forever, daemon=True).start()
        self.address = f"http://{host}:{self._server.server_address[1]}"

    def show(self, frame: Shown) -> None:
        messages = {
            o.topic: result_types().deserialize_cdr(o.data, o.type)
            for o in frame.outputs
            if o.topic in _PARTS
        }
        parts = {
            name: part for topic, message in messages.items() for name, part in _PARTS[topic](message).items()
        }
        if "labels" in messages:
            self._labels = frame.stamp_ns, decode_labels(messages["labels"])
        if "regions" in messages and frame.stamp_ns == self._labels[0]:  # which may come after the labels
            parts |= _labels_by_track(self._labels[1], messages["regions"])
        with self._lock:
            self._count += 1
            self._parts |= parts
            state = {"frame": self._count, "stamp": frame.stamp_ns / 1e9, "parts": sorted(self._parts)}
            self._parts["state"] = ("application/json", json.dumps(state).encode())

    def close(self) -> None:
        self._server.shutdown()
        self._server.server_close()

    def _answer(self, request: BaseHTTPRequestHandler) -> None:
        if not self._is_meant(request.headers.get("Host", "")):
            return request.send_error(403, "another host name")
        name = request.path.split("?")[0].strip("/")  # a key of what is shown, never a path of files
        with self._lock:
            part = ("text/html; charset=utf-8", PAGE.read_bytes()) if not name else self._parts.get(name)
        kind, body = part or ("text/plain", b"not shown yet")
        request.send_response(200 if part else 404)
        request.send_header("Content-Type", kind)
        request.send_header("Content-Length", str(len(body)))
        for header, value in SECURITY_HEADERS.items():
            request.send_header(header, value)
        request.end_headers()
        request.wfile.write(body)

    def _is_meant(self, host: str) -> bool:
        """A page of elsewhere, whose name was made to point here, must not read what is shown."""
        served = str(self._server.server_address[0])
        return not _LOOPBACK.fullmatch(served) or bool(_LOOPBACK.fullmatch(host))


Parts = Mapping[str, tuple[str, bytes]]


def _picture(name: str, pixels: Any) -> Parts:
    return {name: ("image/png", cv2.imencode(".png", pixels[..., ::-1])[1].tobytes())}


def _cloud(message: Any) -> Parts:
    """Count (uint32), of all points x, y, z (float32), their regions (uint32), red, green, blue (uint8)."""
    cloud = decode_cloud(message)
    seen = np.isfinite(cloud.points).all(axis=2)
    points = cloud.points[seen]
    color = cloud.color[seen] if cloud.color is not None else np.full(points.shape, 200, np.uint8)
    offset = next(field.offset for field in message.fields if field.name == "label")
    cells = np.frombuffer(message.data, np.uint8).reshape(-1, message.point_step)
    labels = cells[:, offset : offset + 4].copy().view("<u4").reshape(seen.shape)[seen]
    body = (
        np.uint32(len(points)).tobytes() + points.astype("<f4").tobytes() + labels.tobytes() + color.tobytes()
    )
    return {"cloud": ("application/octet-stream", body)}


def _numbers(message: Any) -> NDArray[np.int64]:
    """(N + 1,) what the colour of each region goes by: its track, which lasts, or its label without one."""
    numbers = np.zeros(len(message.regions) + 1, np.int64)
    for region in message.regions:
        track = int(getattr(region, "track", 0))  # recordings of older versions tell none
        numbers[region.label] = (track - 1) % MOST_NUMBERS + 1 if track else region.label
    return numbers


def _labels_by_track(labels: Any, message: Any) -> Parts:
    """The picture of labels in the colours of their tracks; of a node that shows tracks it is so already."""
    numbers = _numbers(message)
    if labels.max(initial=0) >= len(numbers):
        return {}
    return _picture("labels", labels_picture(numbers[labels]))


def _regions(message: Any) -> Parts:
    numbers = _numbers(message)
    colors = label_colors(int(numbers.max(initial=0)))[numbers]
    rows = [_region_row(region, colors[region.label]) for region in message.regions]
    surfaces = [_surface_row(surface) for surface in message.surfaces]
    return {
        name: ("application/json", json.dumps(part).encode())
        for name, part in (("regions", rows), ("surfaces", surfaces))
    }


def _objects(message: Any) -> Parts:
    colors = label_colors(len(message.objects))
    rows = [
        {
            "label": int(one.label),
            "surfaces": [int(label) for label in one.surfaces],
            "stands_on": int(one.stands_on),
            "size": _rounded([one.box_size.x, one.box_size.y, one.box_size.z]),
            "color": [int(c) for c in colors[one.label]],
            "box": _rounded(box_edges(one.box_pose, one.box_size)),
        }
        for one in message.objects
    ]
    return {"objects": ("application/json", json.dumps(rows).encode())}


def _surface_row(surface: Any) -> dict[str, Any]:
    """What the page tells of a surface: class, shape with its errors, area, outlines (pairs of ends)."""
    name = CATEGORIES[getattr(surface, "category", 0)]  # recordings of older versions tell none
    outlines = [one.points for one in surface_drawings(surface) if one.name == "outlines"]
    row = {
        "label": int(surface.label),
        "pixels": int(surface.pixel_count),
        "category": name,
        "probability": _rounded([getattr(surface, "category_probability", np.nan)])[0],
        "color": [int(c) for c in CATEGORY_COLORS[name]],
        "shape": SHAPES[surface.primitive.kind],
        "parameters": _rounded(surface.primitive.parameters),
        "area": round(sum(float(polygon.area) for polygon in getattr(surface, "polygons", ())), 4),
        "outlines": _rounded(np.concatenate(outlines)) if outlines else [],
    }
    for plane in surface.plane:
        random, systematic = (np.diag(np.reshape(m, (3, 3))) for m in (plane.covariance, plane.systematic))
        row["errors"] = _rounded(1e3 * np.sqrt(random + systematic))  # mrad, mrad, mm
    return row


def _rounded(values: Any) -> list[float | None]:
    return [round(float(v), 4) if np.isfinite(v) else None for v in np.ravel(values)]


def _region_row(region: Any, color: Sequence[int]) -> dict[str, Any]:
    return {
        "label": int(region.label),
        "surface": int(region.surface),
        "pixels": int(region.pixel_count),
        "degrees": [int(region.range_patch.degree), int(region.color_patch.degree)],
        "centroid": _rounded([region.centroid.x, region.centroid.y, region.centroid.z]),
        "size": _rounded([region.extent_size.x, region.extent_size.y, region.extent_size.z]),
        "color": [int(c) for c in color],
        "mean": _rounded(region.mean_color),
        "box": _rounded(box_edges(region.extent_pose, region.extent_size)),
    }


_PARTS: dict[str, Callable[[Any], Parts]] = {
    "overlay": lambda message: _picture("overlay", decode_image(message)),
    "labels": lambda message: _picture("labels", labels_picture(decode_labels(message))),
    "reconstruction": _cloud,
    "regions": _regions,
    "objects": _objects,
}
