"""What goes from frame to frame of a recording: names, and decisions where they are to last."""

from __future__ import annotations

from collections.abc import Callable

from rcseg_core import RangeColorFrame, Segmentation, SegmenterConfig
from rcseg_core.tracking import Segmenter, Tracker
from rcseg_ros.frames.conversions import Header
from rcseg_ros.frames.poses import recorded_poses
from rcseg_ros.recordings.bag import Recording
from rcseg_ros.recordings.segmenting import Segmented
from rcseg_ros.results.made import Named


class Namer:
    """Follows regions from frame to frame, with poses where the recording tells them; called in order.

    Parameters
    ----------
    fixed_frame : of poses by tf; "": poses by odometry, or none
    images : whether label images show track ids
    """

    def __init__(
        self, recording: Recording, config: SegmenterConfig, fixed_frame: str = "", images: bool = False
    ) -> None:
        self._images = images
        self._tracker = Tracker(config)
        self._poses = recorded_poses(recording, fixed_frame)

    def __call__(self, made: Segmented) -> None:
        header = made.header
        pose = self._poses.pose(header.frame_id, header.stamp_ns)
        tracks = self._tracker.update(made.result, header.stamp_ns, pose, made.messages.world)
        made.messages.named = Named(tracks, self._poses.fixed_frame, self._images)


def in_turn(
    recording: Recording, config: SegmenterConfig, fixed_frame: str = ""
) -> Callable[[RangeColorFrame, Header], Segmentation] | None:
    """What segments the frames of a recording in their order, where that is asked for (`tracking.stability`);
    None where every frame stands alone."""
    if config.tracking.stability == 0:
        return None
    segmenter, poses = Segmenter(config), recorded_poses(recording, fixed_frame)

    def segment(frame: RangeColorFrame, header: Header) -> Segmentation:
        return segmenter.segment(frame, header.stamp_ns, poses.pose(header.frame_id, header.stamp_ns))

    return segment
