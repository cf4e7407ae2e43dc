"""The recorded frames beside the repository give what test/data/real_frames.yaml expects of them.

    rcseg evaluate DATA --write-reference test/data/real_frames.yaml

renews the figures. All frames take about 20 s.
"""

import io
from pathlib import Path

import pytest
from rich.console import Console

from rcseg_core import SegmenterConfig
from rcseg_ros.evaluation.evaluate import run_evaluate
from rcseg_ros.evaluation.references import read_reference

REFERENCE = read_reference(Path(__file__).resolve().parents[1] / "data" / "real_frames.yaml")


@pytest.fixture(scope="module")
def report(shared_data):
    return run_evaluate(
        str(shared_data), config=SegmenterConfig(), console=Console(file=io.StringIO()), reference=REFERENCE
    )


@pytest.mark.parametrize("frame", REFERENCE.frames)
def test_a_frame_is_as_good_as_before(report, frame):
    if frame not in report.seconds:
        pytest.skip(f"no frame {frame} among the real data")
    assert REFERENCE.faults(report).get(frame, []) == []


@pytest.mark.parametrize("group", REFERENCE.groups)
def test_a_group_of_frames_is_as_good_as_before(report, group):
    assert REFERENCE.faults(report).get(group, []) == []


def test_the_faces_of_all_three_laptop_frames_are_looked_at():
    for number in range(3):
        faces = REFERENCE.faces[f"bag_pcl_kinect_laptop_box/{number}"]
        assert {"floor", "lid", "box_top", "box_front", "box_side"} <= set(faces)
        assert all(len(points) >= 2 for points in faces.values())
