"""Start the segmentation node on the topics of a sensor.

    ros2 launch rcseg_ros segment.launch.py points:=/camera/depth_registered/points \
        image:=/camera/rgb/image_raw camera_info:=/camera/rgb/camera_info config:=.../kinect_v1.yaml

Every input is an argument; so are the parameter file, autostart, respawn and the transport profile.
"""

import os

from ament_index_python.packages import get_package_share_directory
from launch.actions import DeclareLaunchArgument, OpaqueFunction, SetEnvironmentVariable
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import LifecycleNode
from launch_ros.parameter_descriptions import ParameterValue

from launch import LaunchDescription

INPUTS = {
    "points": "PointCloud2, organised or (with camera_info) not",
    "depth": "depth Image in place of points (REP 118)",
    "image": "colour Image",
    "camera_info": "CameraInfo of the pixel grid that both are registered to, or of the colour image",
    "depth_camera_info": "CameraInfo of a depth Image of another camera than the colour's",
}


def check_config(context) -> None:
    """Refuse a parameter file that is not there, before anything starts: launch itself would only warn."""
    path = LaunchConfiguration("config").perform(context)
    if not os.path.isfile(path):
        raise RuntimeError(f"config:={path}: no such file; name a parameter file, or leave config away")


def generate_launch_description() -> LaunchDescription:
    config = os.path.join(get_package_share_directory("rcseg_ros"), "config")
    arguments = [
        DeclareLaunchArgument(
            "name", default_value="rcseg", description="name of the node and of its outputs"
        ),
        DeclareLaunchArgument("namespace", default_value="", description="namespace of the node"),
        DeclareLaunchArgument(
            "config",
            default_value=os.path.join(config, "default.yaml"),
            description="parameter file; config/README.md says which to take",
        ),
        DeclareLaunchArgument(
            "autostart",
            default_value="true",
            description="configure and activate without a lifecycle manager",
        ),
        DeclareLaunchArgument(
            "respawn", default_value="false", description="start the node again if it ends"
        ),
        DeclareLaunchArgument("use_sim_time", default_value="false", description="take the time from /clock"),
        DeclareLaunchArgument("log_level", default_value="info", description="debug, info, warn, error"),
        DeclareLaunchArgument(
            "large_messages",
            default_value="false",
            description="use the Fast DDS profile for large messages; the sensor driver must use it too",
        ),
    ]
    arguments += [
        DeclareLaunchArgument(topic, default_value=topic, description=text) for topic, text in INPUTS.items()
    ]
    profile = SetEnvironmentVariable(
        "FASTRTPS_DEFAULT_PROFILES_FILE",
        os.path.join(config, "fastdds_large_messages.xml"),
        condition=IfCondition(LaunchConfiguration("large_messages")),
    )
    node = LifecycleNode(
        package="rcseg_ros",
        executable="segmentation_node",
        name=LaunchConfiguration("name"),
        namespace=LaunchConfiguration("namespace"),
        parameters=[
            LaunchConfiguration("config"),
            {
                "autostart": ParameterValue(LaunchConfiguration("autostart"), value_type=bool),
                "use_sim_time": ParameterValue(LaunchConfiguration("use_sim_time"), value_type=bool),
            },
        ],
        remappings=[(topic, LaunchConfiguration(topic)) for topic in INPUTS],
        arguments=["--ros-args", "--log-level", LaunchConfiguration("log_level")],
        respawn=LaunchConfiguration("respawn"),
        respawn_delay=2.0,
        output="screen",
        emulate_tty=True,
    )
    return LaunchDescription([*arguments, OpaqueFunction(function=check_config), profile, node])
