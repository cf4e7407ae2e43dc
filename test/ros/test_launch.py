"""Launch files and viewer files name what the node has: executable, parameters, topics.

`launch` is not among the ROS wheels, so a small recorder stands in for it; where ROS is installed the real
one loads the files too.
"""

from __future__ import annotations

import importlib.util
import json
import sys
import types
import xml.etree.ElementTree
from pathlib import Path
from types import SimpleNamespace

import pytest
import yaml

ROOT = Path(__file__).parents[2]
INPUTS = {"points", "depth", "image", "camera_info", "depth_camera_info"}


def _recorder(kind):
    return lambda *args, **named: SimpleNamespace(kind=kind, args=args, named=named)


@pytest.fixture
def recorded_launch(monkeypatch):
    """The modules of launch and launch_ros as recorders: each action keeps how it was made."""
    names = {
        "launch": ["LaunchDescription"],
        "launch.actions": [
            "DeclareLaunchArgument", "ExecuteProcess", "IncludeLaunchDescription", "LogInfo",
            "OpaqueFunction", "SetEnvironmentVariable",
        ],
        "launch.conditions": ["IfCondition", "UnlessCondition"],
        "launch.launch_description_sources": ["PythonLaunchDescriptionSource"],
        "launch.substitutions": ["LaunchConfiguration"],
        "launch_ros": [],
        "launch_ros.actions": ["LifecycleNode", "Node"],
        "launch_ros.parameter_descriptions": ["ParameterValue"],
        "ament_index_python": [],
        "ament_index_python.packages": [],
    }  # fmt: skip
    for name, members in names.items():
        module = types.ModuleType(name)
        module.__dict__.update({member: _recorder(member) for member in members})
        monkeypatch.setitem(sys.modules, name, module)
    packages = sys.modules["ament_index_python.packages"]
    packages.get_package_share_directory = lambda package: str(ROOT)
    packages.get_packages_with_prefixes = lambda: {"rviz2": "/opt/ros/jazzy"}


def _load(name):
    spec = importlib.util.spec_from_file_location(name, ROOT / "launch" / f"{name}.launch.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    (actions,) = module.generate_launch_description().args
    arguments = {a.args[0]: a.named for a in actions if a.kind == "DeclareLaunchArgument"}
    return arguments, [a for a in actions if a.kind != "DeclareLaunchArgument"]


def _used(value):
    """Names of all launch configurations inside an action."""
    if isinstance(value, SimpleNamespace):
        own = {value.args[0]} if value.kind == "LaunchConfiguration" else set()
        return own.union(*map(_used, [*value.args, *value.named.values()]))
    if isinstance(value, dict):
        return set().union(*map(_used, value.values()))
    if isinstance(value, (list, tuple)) or type(value).__name__ == "dict_items":
        return set().union(*map(_used, value))
    return set()


def test_segment_launch(recorded_launch):
    arguments, actions = _load("segment")
    (node,) = [a for a in actions if a.kind == "LifecycleNode"]
    assert (node.named["package"], node.named["executable"]) == ("rcseg_ros", "segmentation_node")
    assert "segmentation_node = rcseg_ros.node:main" in (ROOT / "setup.py").read_text()
    assert {topic for topic, _ in node.named["remappings"]} == INPUTS
    assert arguments.keys() >= INPUTS | {"config", "autostart", "respawn", "use_sim_time", "namespace"}
    assert _used(node) | {"large_messages"} == set(arguments), (
        "an argument that nothing uses, or none for a use"
    )
    assert Path(arguments["config"]["default_value"]).is_file()
    (profile,) = [a for a in actions if a.kind == "SetEnvironmentVariable"]
    assert Path(profile.args[1]).is_file()


def test_replay_launch(recorded_launch):
    arguments, actions = _load("replay")
    assert "default_value" not in arguments["bag"]
    assert set().union(*map(_used, actions)) == set(arguments)
    played = [a for a in actions if a.kind == "ExecuteProcess"]
    assert [a.named["condition"].kind for a in played] == ["IfCondition", "UnlessCondition"]
    for action in played:
        assert action.named["cmd"][:3] == ["ros2", "bag", "play"] and "--clock" in action.named["cmd"]
    (included,) = [a for a in actions if a.kind == "IncludeLaunchDescription"]
    segment_arguments, _ = _load("segment")
    assert dict(included.named["launch_arguments"]).keys() <= segment_arguments.keys()
    (rviz,) = [a for a in actions if a.kind == "Node"]
    assert Path(rviz.named["arguments"][1]).is_file()


def test_replay_without_rviz_goes_on_with_a_word(recorded_launch, monkeypatch):
    """A node of a package that is missing ends the launch when others run already, which then live on."""
    packages = sys.modules["ament_index_python.packages"]
    monkeypatch.setattr(packages, "get_packages_with_prefixes", dict)
    _, actions = _load("replay")
    assert not [a for a in actions if a.kind == "Node"]
    (word,) = [a for a in actions if a.kind == "LogInfo"]
    assert "rviz2 is not installed" in word.named["msg"] and _used(word) == {"rviz"}


def test_a_config_file_that_is_missing_is_refused_before_anything_starts(recorded_launch, monkeypatch):
    _, actions = _load("segment")
    assert actions[0].kind == "OpaqueFunction"
    check = actions[0].named["function"]
    given = SimpleNamespace(perform=lambda context: context)
    monkeypatch.setitem(check.__globals__, "LaunchConfiguration", lambda name: given)
    check(str(ROOT / "config" / "default.yaml"))
    with pytest.raises(RuntimeError, match=r"config:=/nowhere.yaml: no such file"):
        check("/nowhere.yaml")


@pytest.mark.skipif(
    not importlib.util.find_spec("launch_ros"), reason="launch_ros comes with a ROS installation"
)
@pytest.mark.parametrize("name", ["segment", "replay"])
def test_the_real_launch_loads_the_files(name, monkeypatch):
    packages = pytest.importorskip("ament_index_python.packages")
    monkeypatch.setattr(packages, "get_package_share_directory", lambda package: str(ROOT))
    spec = importlib.util.spec_from_file_location(name, ROOT / "launch" / f"{name}.launch.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    assert module.generate_launch_description().entities


SHOWN = {
    "labels", "overlay", "markers", "reconstruction", "class_mask", "object_labels", "ground_points",
    "obstacle_points",
}  # fmt: skip


def test_rviz_shows_outputs_of_the_node():
    config = yaml.safe_load((ROOT / "config/rcseg.rviz").read_text())
    displays = config["Visualization Manager"]["Displays"]
    topics = {d["Topic"]["Value"].removeprefix("/rcseg/") for d in displays if "Topic" in d}
    assert topics == SHOWN


def test_foxglove_layout_shows_outputs_of_the_node():
    layout = json.loads((ROOT / "config/foxglove.json").read_text())
    panels = layout["configById"]
    shown = {c["imageMode"]["imageTopic"] for c in panels.values() if "imageMode" in c}
    shown |= panels["3D!scene"]["topics"].keys()
    assert {t.removeprefix("/rcseg/") for t in shown} == SHOWN

    def leaves(node):
        return [node] if isinstance(node, str) else leaves(node["first"]) + leaves(node["second"])

    assert sorted(leaves(layout["layout"])) == sorted(panels)


def test_the_readme_of_config_names_every_file():
    text = (ROOT / "config/README.md").read_text()
    for path in (ROOT / "config").rglob("*"):
        if path.is_file() and path.name != "README.md":
            assert f"`{path.relative_to(ROOT / 'config')}`" in text


def test_the_transport_profile_is_what_the_readme_says():
    tree = xml.etree.ElementTree.parse(ROOT / "config/fastdds_large_messages.xml")
    space = {"d": "http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles"}
    assert int(tree.find(".//d:segment_size", space).text) == 128 * 2**20
    assert int(tree.find(".//d:maxMessageSize", space).text) == 16 * 2**20


def test_setup_installs_everything():
    setup = (ROOT / "setup.py").read_text()
    for pattern in ("launch/*.launch.py", "config/*.*", "config/sensors/*.yaml"):
        assert f'glob("{pattern}")' in setup
