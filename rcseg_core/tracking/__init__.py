"""Regions over time: the same surface keeps its name from frame to frame.

A pass of its own after segmentation, sequential and cheap, so that frames can be segmented in any order on
all processors. It reads results, their models and the shapes that surfaces are; nothing in the pipeline knows
of it. For others: `Tracker`, and what its `update` returns, `Tracks` of `Track`.
"""

from rcseg_core.tracking.segmenter import Segmenter
from rcseg_core.tracking.tracker import Tracker
from rcseg_core.tracking.tracks import KINDS, STATES, Track, Tracks

__all__ = ["KINDS", "STATES", "Segmenter", "Track", "Tracker", "Tracks"]
