"""Where `rcseg view` shows results: a page for any browser, and a WebSocket server for Foxglove and
Lichtblick.

Both are fed with the serialised messages that the node publishes, so what is shown is what a robot
receives. The page needs nothing but this package; the WebSocket server needs foxglove-sdk.
"""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from rcseg_core.drawing import label_colors, labels_picture
from rcseg_core.errors import InputError
from rcseg_ros.conversions import decode_cloud, decode_image, decode_labels
from rcseg_ros.markers import box_edges
from rcseg_ros.result_bag import definition_text, result_types
from rcseg_ros.segmenting import Output

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
        viewer = self

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                viewer._answer(self)

            def log_message(self, *_: Any) -> None:
                pass  # a line a request would bury what matters

        try:
            self._server = ThreadingHTTPServer((host, port), Handler)
        except OSError as error:
            raise InputError(
                f"view: cannot serve the page on {host}:{port}: {error.strerror}; try --port"
            ) from error
        self._server.daemon_threads = True
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
        with self._lock:
            self._count += 1
            self._parts |= parts
            state = {"frame": self._count, "stamp": frame.stamp_ns / 1e9, "parts": sorted(self._parts)}
            self._parts["state"] = ("application/json", json.dumps(state).encode())

    def close(self) -> None:
        self._server.shutdown()
        self._server.server_close()

    def _answer(self, request: BaseHTTPRequestHandler) -> None:
        name = request.path.split("?")[0].strip("/")
        with self._lock:
            part = ("text/html; charset=utf-8", PAGE.read_bytes()) if not name else self._parts.get(name)
        kind, body = part or ("text/plain", b"not shown yet")
        request.send_response(200 if part else 404)
        request.send_header("Content-Type", kind)
        request.send_header("Content-Length", str(len(body)))
        request.send_header("Cache-Control", "no-store")
        request.end_headers()
        request.wfile.write(body)


Parts = Mapping[str, tuple[str, bytes]]


def _picture(name: str, pixels: Any) -> Parts:
    return {name: ("image/png", cv2.imencode(".png", pixels[..., ::-1])[1].tobytes())}


def _cloud(message: Any) -> Parts:
    """Count (uint32), then x, y, z (float32) of all points, then their red, green and blue (uint8)."""
    cloud = decode_cloud(message)
    seen = np.isfinite(cloud.points).all(axis=2)
    points = cloud.points[seen]
    color = cloud.color[seen] if cloud.color is not None else np.full(points.shape, 200, np.uint8)
    body = np.uint32(len(points)).tobytes() + points.astype("<f4").tobytes() + color.tobytes()
    return {"cloud": ("application/octet-stream", body)}


def _regions(message: Any) -> Parts:
    colors = label_colors(len(message.regions))
    rows = [_region_row(region, colors[region.label]) for region in message.regions]
    return {"regions": ("application/json", json.dumps(rows).encode())}


def _region_row(region: Any, color: Sequence[int]) -> dict[str, Any]:
    def plain(values: Any) -> Any:
        return [round(float(v), 4) if np.isfinite(v) else None for v in np.ravel(values)]

    return {
        "label": int(region.label),
        "surface": int(region.surface),
        "pixels": int(region.pixel_count),
        "degrees": [int(region.range_patch.degree), int(region.color_patch.degree)],
        "centroid": plain([region.centroid.x, region.centroid.y, region.centroid.z]),
        "size": plain([region.extent_size.x, region.extent_size.y, region.extent_size.z]),
        "color": [int(c) for c in color],
        "mean": plain(region.mean_color),
        "box": plain(box_edges(region)),
    }


_PARTS: dict[str, Callable[[Any], Parts]] = {
    "overlay": lambda message: _picture("overlay", decode_image(message)),
    "labels": lambda message: _picture("labels", labels_picture(decode_labels(message))),
    "reconstruction": _cloud,
    "regions": _regions,
}
