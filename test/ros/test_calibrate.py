"""`rcseg calibrate` from a recording to the file, the picture and the table; errors in one line."""

import cv2
import numpy as np
import pytest
import yaml
from recordings import COLOR, DEPTH, INFO, Entry, head, info_message, stamps, write_folder, write_mcap

from rcseg_core import PinholeCamera, RangeColorFrame, SegmenterConfig, segment
from rcseg_ros.cli import main
from rcseg_ros.commands.calibrate import calibrate_recording
from rcseg_ros.recordings.result_bag import make_message
from rcseg_ros.results.outputs import depth_message, picture_message
from rcseg_ros.settings import load_config

HEIGHT, WIDTH = 120, 160
CAMERA = PinholeCamera(130.0, 130.0, 79.5, 59.5)
SIGMA = 2e-3


def wall(seed, shift=0.0):
    """A floor and a wall, noise of 2e-3 per metre."""
    rows, cols = np.mgrid[:HEIGHT, :WIDTH]
    w = np.maximum(0.4 + 4e-4 * cols, 0.3 + 6.6e-3 * rows) + shift
    depth_m = 1.0 / (w + SIGMA * np.random.default_rng(seed).normal(size=w.shape))
    return RangeColorFrame.from_depth(
        depth_m.astype(np.float32), np.full((HEIGHT, WIDTH, 3), 120, np.uint8), CAMERA
    )


def entries(count, step=0.0):
    out = []
    for i, stamp in enumerate(stamps(count)):
        frame = wall(i, i * step)
        out += [
            Entry(INFO, info_message(stamp, HEIGHT, WIDTH, CAMERA.matrix()), stamp),
            Entry(DEPTH, depth_message(frame.depth_m, head(stamp), make_message), stamp),
            Entry(COLOR, picture_message(frame.color, head(stamp), make_message), stamp),
        ]
    return out


@pytest.fixture
def run(tmp_path, capsys, monkeypatch):
    """Run the command line in an empty folder; return exit code, output and errors."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "160")

    def call(*arguments):
        code = main([str(argument) for argument in arguments])
        return code, *capsys.readouterr()

    return call


def test_a_static_recording_makes_a_file_that_states_its_law(run, tmp_path):
    write_folder(tmp_path / "wall", entries(8))
    code, out, err = run("calibrate", "wall", "-o", "sensor.yaml")
    assert code == 0, err
    out = " ".join(out.split())  # where lines are broken depends on the length of the paths
    assert "8 of 8 frames stand still" in out and "temporal" in out and "written to sensor.yaml" in out
    config = load_config(tmp_path / "sensor.yaml", ())
    assert config.noise.range_model == "law"
    w = np.array([0.5, 1.0])
    # neither planes nor bend follow the noise of an image as small as this
    noise = segment(wall(99), config).noise
    assert noise.range_sigma(w) == pytest.approx(SIGMA, rel=0.03)
    assert noise.range_correlation == pytest.approx(1.0, abs=0.8) and noise.range_systematic < 0.2
    picture = cv2.imread(str(tmp_path / "sensor.png"))
    assert picture is not None and picture.shape[1] > 1000 and picture.std() > 5


def test_the_file_is_one_of_ros_parameters_whose_numbers_keep_their_types(run, tmp_path):
    write_mcap(tmp_path / "wall.mcap", entries(6))
    assert run("calibrate", "wall.mcap")[0] == 0
    text = (tmp_path / "wall_sensor.yaml").read_text()
    noise = yaml.safe_load(text)["/**"]["ros__parameters"]["noise"]
    assert all(type(value) is float for key, value in noise.items() if key != "range_model")
    assert set(noise) < {key.split(".")[1] for key in _keys()}
    assert "measured by `rcseg calibrate wall.mcap`" in text


def _keys():
    from rcseg_core.config import describe

    return [p.key for p in describe(SegmenterConfig()) if p.key.startswith("noise.")]


def test_a_moving_camera_is_told_and_parts_that_it_hides_are_a_dash(run, tmp_path):
    write_folder(tmp_path / "drive", entries(4, step=0.05))
    code, out, _ = run("calibrate", "drive", "-o", "sensor.yaml", "--max-frames", 3)
    assert code == 0
    assert "no 5 frames in a row stand still" in out and "3 single frames of 3" in out and " - " in out


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("nowhere",), "nowhere: no such file"),
        (("wall", "-o", "sensor.txt"), "ends in .yaml"),
        (("wall", "-o", "there.yaml"), "there.yaml: exists already"),
        (("wall", "--range-from", "sonar"), "--range-from sonar"),
        (("wall", "--topics", "color=/none"), "/none"),
    ],
)
def test_errors_are_one_line_and_nothing_is_written(run, tmp_path, arguments, words):
    write_folder(tmp_path / "wall", entries(1))
    (tmp_path / "there.yaml").write_text("mine")
    code, _, err = run("calibrate", *arguments)
    assert code == 2
    assert words in err and len(err.strip().splitlines()) == 1
    assert sorted(path.name for path in tmp_path.iterdir()) == ["there.yaml", "wall"]
    assert (tmp_path / "there.yaml").read_text() == "mine"


def test_force_overwrites(run, tmp_path):
    write_folder(tmp_path / "wall", entries(1))
    (tmp_path / "there.yaml").write_text("mine")
    assert run("calibrate", "wall", "-o", "there.yaml", "--force")[0] == 0
    assert "range_law_a" in (tmp_path / "there.yaml").read_text()


def test_a_recording_without_a_plane_is_refused_by_name(run, tmp_path):
    stamp = stamps(1)[0]
    depth_m = np.full((HEIGHT, WIDTH), np.nan, np.float32)
    depth_m[::9, ::9] = 1.0  # single pixels
    color = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    write_folder(
        tmp_path / "rubble",
        [
            Entry(INFO, info_message(stamp, HEIGHT, WIDTH, CAMERA.matrix()), stamp),
            Entry(DEPTH, depth_message(depth_m, head(stamp), make_message), stamp),
            Entry(COLOR, picture_message(color, head(stamp), make_message), stamp),
        ],
    )
    code, _, err = run("calibrate", "rubble")
    assert code == 2 and "rubble: calibrate: no plane" in err and len(err.strip().splitlines()) == 1


def test_an_interrupt_keeps_what_was_read(tmp_path, monkeypatch):
    from rcseg_ros.commands import calibrate as module

    class Pressed(module.Interrupt):
        """As if Ctrl-C came while the seventh frame is read."""

        asked = 0

        @property
        def requested(self):
            Pressed.asked += 1
            return Pressed.asked > 6

        @requested.setter
        def requested(self, value):
            pass

    monkeypatch.setattr(module, "Interrupt", Pressed)
    write_folder(tmp_path / "wall", entries(9))
    request = module.CalibrateRequest(tmp_path / "wall", tmp_path / "sensor.yaml")
    done = calibrate_recording(request)
    assert done.interrupted and done.found.frames == 6
    assert request.output.exists() and request.picture.exists()
