"""Renews what the documents and the tests say of the recorded frames: tables, pictures and the reference.

python docs/make_real_frames.py DATA

Writes test/data/real_frames.yaml, the marked parts of docs/results.md and docs/real_frames.md, and
docs/pictures/real_*.jpg. The words below the tables are by hand: look at the pictures and say it anew.
"""

import sys
import tempfile
from pathlib import Path

import cv2
from rich.console import Console

from rcseg_core import SegmenterConfig
from rcseg_core.evaluation.metrics import REPORT_TOLERANCE
from rcseg_ros.commands.terminal import prepare
from rcseg_ros.evaluation.evaluate import Report, run_evaluate
from rcseg_ros.evaluation.references import read_reference, write_reference
from rcseg_ros.evaluation.reports import markdown_tables

HERE = Path(__file__).resolve().parent
REFERENCE = HERE.parent / "test" / "data" / "real_frames.yaml"
BEGIN, END = "<!-- made by docs/make_real_frames.py -->", "<!-- end -->"
SHEETS = (
    "pcl_office1",
    "bag_pcl_kinect_laptop_box/1",
    "middlebury_motorcycle",
    "mosd_learn5",
    "mosd_learn40",
    "synpeb/test_500",
)
"""Frames whose sheets are shown in docs/real_frames.md."""
WIDTH_PX = 1440


def main(data: str) -> None:
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch) / "evaluation"
        report = run_evaluate(
            data,
            config=SegmenterConfig(),
            console=Console(),
            warm_up=prepare,
            output=folder,
            reference=read_reference(REFERENCE),
        )
        write_reference(REFERENCE, report)
        _write_picture(folder / "overview.png", "frames")
        for name in SHEETS:
            _write_picture(folder / "pictures" / f"{name.replace('/', '_')}.png", name.replace("/", "_"))
    _replace(HERE / "results.md", markdown_tables(report, REPORT_TOLERANCE, pooled_only=True))
    _replace(HERE / "real_frames.md", markdown_tables(report, REPORT_TOLERANCE) + "\n\n" + _faults(report))


def _faults(report: Report) -> str:
    """Every false blob and every fault of a face, as lists."""
    blobs = [
        f"- {m.name}: {b.pixel_count} px at row {b.row}, column {b.col}"
        for m in report.frames
        for b in m.blobs or ()
    ]
    faces = [f"- {name}: {text}" for name, texts in report.face_faults.items() for text in texts]
    heads = (
        "Surfaces inside of one that explains them",
        "Faces with points set by hand that are not one surface each",
    )
    lists = (blobs or ["- none"], faces or ["- none"])
    return "\n\n".join(f"**{head}**\n\n" + "\n".join(lines) for head, lines in zip(heads, lists, strict=True))


def _write_picture(source: Path, name: str) -> None:
    """A sheet as a smaller JPEG: photographs are too large as PNG to be kept with the sources."""
    picture = cv2.imread(str(source))
    scale = min(1.0, WIDTH_PX / picture.shape[1])
    small = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    cv2.imwrite(str(HERE / "pictures" / f"real_{name}.jpg"), small, [cv2.IMWRITE_JPEG_QUALITY, 80])


def _replace(path: Path, text: str) -> None:
    """Put a text between the marks of a document."""
    before, mark, rest = path.read_text("utf-8").partition(BEGIN)
    _, end, after = rest.partition(END)
    if not (mark and end):
        sys.exit(f"{path}: the lines {BEGIN} and {END} are missing")
    path.write_text(f"{before}{BEGIN}\n\n{text}\n\n{END}{after}", "utf-8")


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    main(sys.argv[1])
