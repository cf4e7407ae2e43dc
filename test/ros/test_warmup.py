"""A long compile is announced while it lasts, a warm start says nothing; after `rcseg warmup` nothing is left
to compile, and it says where the kernels lie."""

import contextlib
import subprocess
import sys
import threading
import time
from pathlib import Path
from types import SimpleNamespace

from rcseg_core import SegmenterConfig
from rcseg_core.config import describe
from rcseg_ros import warmup
from rcseg_ros.cli import main
from rcseg_ros.live.health import Health

BAGS = Path(__file__).resolve().parents[2] / "bags"


def run(monkeypatch, seconds):
    frames, said = [], []

    def slow(frame, config):
        frames.append(frame)
        time.sleep(seconds)

    monkeypatch.setattr(warmup, "_use", slow)
    monkeypatch.setattr(warmup, "_PATIENCE_S", 0.1)
    monkeypatch.setattr(warmup, "_BEAT_S", 0.1)
    took = warmup.warm_up(SegmenterConfig(), said.append)
    (frame,) = frames
    assert took >= seconds and frame.valid.any() and not frame.valid.all()
    return said


def test_a_long_compile_is_announced_and_goes_on_being_told(monkeypatch):
    said = run(monkeypatch, 0.5)
    assert said[0].startswith("Compiling the kernels")
    assert len(said) >= 4 and "still compiling" in said[1] and "compiled in" in said[-1]


def test_a_warm_start_is_silent(monkeypatch):
    assert run(monkeypatch, 0.0) == []


def test_every_choice_and_every_switch_is_among_the_cases():
    """A kernel may hang on any of them; calibrated reflectance needs a second frame, and has none."""
    used = {(p.key, p.value) for _, _, config in warmup._cases() for p in describe(config)}
    for parameter in describe(SegmenterConfig()):
        for value in parameter.choices or ((True, False) if parameter.type is bool else ()):
            assert ((parameter.key, value) in used) == (value != "calibrated"), (parameter.key, value)


def test_after_it_nothing_is_left_to_compile(tmp_path):
    """In a process of its own: recorded depth, colour and clouds, and scenes that the cases do not hold.

    A kernel that is asked for other types than before would be compiled where the cache is empty.
    """
    program = f"""
import sys
sys.path.insert(0, {str(Path(__file__).parent)!r})
from pathlib import Path
import recordings
from rcseg_core import RangeColorFrame, SegmenterConfig, segment
from rcseg_core.synthetic import make_scene
from rcseg_ros import warmup
from rcseg_ros.commands.replay import ReplayRequest, replay
def signatures():
    return {{(k.__module__, k.__name__, str(types)) for k in warmup._kernels() for types in k.signatures}}
warmup.fill_cache()
before = signatures()
folder = Path({str(tmp_path)!r})
recordings.write_folder(folder / "depth", recordings.depth_entries(1))
recordings.write_folder(folder / "cloud", recordings.cloud_entries(1))
bags = folder / "depth", folder / "cloud", Path({str(BAGS / "tabletop")!r})
for i, bag in enumerate(bags):
    replay(ReplayRequest(bag, folder / str(i), SegmenterConfig(), max_frames=1))
frame = make_scene("blocks", 5, width=320, height=240).frame
frame.color.setflags(write=False)
segment(RangeColorFrame(frame.points[:, ::2], frame.color[:, ::2])).regions
late = signatures() - before
assert not late, sorted(late)
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_the_first_frame_after_a_start_loads_no_kernel():
    """In a process of its own: whatever a frame of full height needs, the warm-up has loaded."""
    program = """
from rcseg_core import SegmenterConfig, segment
from rcseg_core.synthetic import make_scene
from rcseg_ros import warmup
def signatures():
    return {(k.__module__, k.__name__, str(types)) for k in warmup._kernels() for types in k.signatures}
frame = make_scene("room", 6, width=240, height=320, structured_light=True).frame
warmup.warm_up(SegmenterConfig(), print)
before = signatures()
segment(frame, SegmenterConfig())
print("new:", sorted(signatures() - before))
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=600)
    assert done.stdout.splitlines()[-1] == "new: []", done.stdout + done.stderr


def test_the_command_tells_time_and_place(capsys, monkeypatch):
    seen = []
    monkeypatch.setattr(warmup, "_use", lambda frame, config: seen.append(config))
    assert main(["warmup"]) == 0
    text = " ".join(capsys.readouterr().out.split())
    assert len(seen) > 15 and " MB kept in " in text
    place = Path(text.partition(" MB kept in ")[2].split()[0])
    assert any(place.glob("kernels-graph.grouping-*")), place


def test_kernels_that_cannot_be_kept_are_an_error(capsys, monkeypatch, tmp_path):
    lost = tmp_path / "rcseg-kernels-abc"
    lost.mkdir()
    monkeypatch.setattr(warmup, "cache_folder", lambda module: str(lost))
    monkeypatch.setattr(warmup, "_use", lambda frame, config: None)
    assert main(["warmup"]) == 2
    error = capsys.readouterr().err
    assert "NUMBA_CACHE_DIR" in error and str(tmp_path) in error and error.count("\n") == 1


def test_an_interrupt_keeps_what_was_compiled(capsys, monkeypatch):
    def interrupted(frame, config):
        raise KeyboardInterrupt

    monkeypatch.setattr(warmup, "_use", interrupted)
    assert main(["warmup"]) == 130
    assert "goes on from there" in capsys.readouterr().out


def test_diagnostics_tell_of_the_compile_while_it_lasts():
    health = Health()

    def message(state):
        return health.status("node", state, {}, lambda kind, **fields: SimpleNamespace(**fields)).message

    assert message("configuring") == "configuring"
    health.progress("  still compiling, 20 s")
    assert message("configuring") == "still compiling, 20 s"
    health.progress("")
    assert message("inactive") == "inactive"


def test_the_node_answers_and_reports_while_it_compiles(live, monkeypatch):
    """Services and diagnostics go on during a configure of seconds, asked for by a service itself."""
    from rclpy.context import Context
    from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor

    from rcseg_ros import node as node_module

    def compile_slowly(config, announce):
        for beat in range(4):
            announce(f"  still compiling, {beat} s")
            time.sleep(1)
        return 4.0

    monkeypatch.setattr(node_module, "warm_up", compile_slowly)
    for name, value in live.ISOLATED.items():
        monkeypatch.setenv(name, value)
    context = Context()
    node_module.rclpy.init(context=context, args=["--ros-args", "-r", "__node:=compiling"])
    node = node_module.SegmentationNode(context=context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)

    def spin():
        with contextlib.suppress(ExternalShutdownException):
            executor.spin()

    thread = threading.Thread(target=spin)
    thread.start()
    monkeypatch.setattr(node_module.rclpy, "ok", lambda: context.ok())
    peer = live.Peer("compiling", ())
    try:
        assert peer.state() == "unconfigured"
        asked = threading.Thread(target=lambda: peer.change_state("configure"))
        asked.start()
        live.wait_until(lambda: peer.diagnostics().get("message", "").startswith("still compiling"), 10)
        started, answered = time.monotonic(), 0
        while asked.is_alive():
            peer.state()
            assert peer.get_parameters("input.queue")[0].integer_value == 1
            answered += asked.is_alive()
        assert answered > 3 and time.monotonic() - started < 30
        assert peer.state() == "inactive"
    finally:
        peer.close()
        node.close()
        context.try_shutdown()
        thread.join(10)
        node.destroy_node()
