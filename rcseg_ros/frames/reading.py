"""What messages do not tell of themselves, and a user may have to: units and bits.

The node's parameters ``input.*``, the options of `rcseg replay` and the decoders share these defaults.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Reading:
    """How numbers in messages are read.

    Attributes
    ----------
    depth_unit_m : float
        Metres of one unit of depth images and of clouds; 0: millimetres of whole numbers and metres of others
        in images (REP 118), metres in clouds.
    max_depth_m : float
        A median beyond it is taken for a wrong unit; single values beyond ABSURD times it for no depth.
    color_bits : int
        Bits that 16-bit images use; 0: the fewest of BITS that hold the image's brightest pixel.
    """

    depth_unit_m: float = 0.0
    max_depth_m: float = 100.0
    color_bits: int = 0

    @classmethod
    def of(cls, parameter: Callable[[str], Any]) -> Reading:
        """As the node's parameters say; `parameter` gives the value of a key."""
        return cls(parameter("input.depth_unit"), parameter("input.max_depth"), parameter("input.color_bits"))


DEFAULT_READING = Reading()
#: Bits that cameras use of 16.
BITS = (8, 10, 12, 14, 16)
#: No pixel of a depth camera lies this many times beyond the largest median.
ABSURD = 10.0
