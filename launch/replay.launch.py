"""Play a recording into the segmentation node, and show it in RViz.

    ros2 launch rcseg_ros replay.launch.py bag:=BAG rate:=0.5 points:=/cloud image:=/rgb camera_info:=/info

RViz is left out, with a word, where it is not installed.
For results of every frame without a ROS graph, `rcseg replay` is the better tool: nothing is dropped there.
"""

from __future__ import annotations

import os

from ament_index_python.packages import get_package_share_directory, get_packages_with_prefixes
from launch.actions import DeclareLaunchArgument, ExecuteProcess, IncludeLaunchDescription, LogInfo
from launch.conditions import IfCondition, UnlessCondition
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from launch import LaunchDescription

PASSED_ON = ("points", "depth", "image", "camera_info")


def generate_launch_description() -> LaunchDescription:
    share = get_package_share_directory("rcseg_ros")
    arguments = [
        DeclareLaunchArgument("bag", description="rosbag2 folder or .mcap file"),
        DeclareLaunchArgument("rate", default_value="1.0", description="playing speed"),
        DeclareLaunchArgument("delay", default_value="5", description="seconds before it plays"),
        DeclareLaunchArgument("loop", default_value="false", description="play again and again"),
        DeclareLaunchArgument("rviz", default_value="true", description="show the results in RViz"),
        DeclareLaunchArgument(
            "config",
            default_value=os.path.join(share, "config", "default.yaml"),
            description="parameter file",
        ),
        *(
            DeclareLaunchArgument(topic, default_value=topic, description="topic in the bag")
            for topic in PASSED_ON
        ),
    ]
    segment = IncludeLaunchDescription(
        PythonLaunchDescriptionSource(os.path.join(share, "launch", "segment.launch.py")),
        launch_arguments={
            "config": LaunchConfiguration("config"),
            "use_sim_time": "true",
            **{topic: LaunchConfiguration(topic) for topic in PASSED_ON},
        }.items(),
    )
    # A node that has run before configures within the delay; to compile for the first time takes 60 s.
    play = ["ros2", "bag", "play", LaunchConfiguration("bag"), "--clock"]
    play += ["--delay", LaunchConfiguration("delay"), "--rate", LaunchConfiguration("rate")]
    looped = LaunchConfiguration("loop")
    return LaunchDescription(
        [
            *arguments,
            segment,
            ExecuteProcess(cmd=[*play, "--loop"], output="screen", condition=IfCondition(looped)),
            ExecuteProcess(cmd=play, output="screen", condition=UnlessCondition(looped)),
            _rviz(share),
        ]
    )


def _rviz(share: str) -> Node | LogInfo:
    """RViz, or a word where it is missing: a node of no package would end the launch and leave the others."""
    wanted = IfCondition(LaunchConfiguration("rviz"))
    if "rviz2" not in get_packages_with_prefixes():
        return LogInfo(msg="rviz2 is not installed: going on without it", condition=wanted)
    return Node(
        package="rviz2",
        executable="rviz2",
        arguments=["-d", os.path.join(share, "config", "rcseg.rviz")],
        parameters=[{"use_sim_time": True}],
        condition=wanted,
    )
