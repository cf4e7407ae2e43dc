"""RVL, the lossless code of compressedDepth for 16 bits: A. D. Wilson, Fast Lossless Depth Image Compression,
ISS 2017.

Numbers are written in groups of three bits, the lowest first, with a fourth bit that says whether more
follow; eight groups fill a 32-bit word from its upper end. They are, in turn: how many pixels are zero, how
many follow that are not, and for each of these its difference to the one before, with the sign in the lowest
bit.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def decode_rvl(data: NDArray[np.uint8], count: int) -> NDArray[np.uint16]:
    """Pixels of an RVL stream.

    Parameters
    ----------
    data : (N,) uint8, without headers
    count : number of pixels

    Returns
    -------
    (count,) uint16

    Raises
    ------
    ValueError
        The stream ends too early, or its runs exceed the image.
    """
    numbers = _numbers(data)
    lengths, headers = _runs(numbers.tolist(), count)
    is_delta = np.ones(numbers.size, bool)
    is_delta[headers], is_delta[np.add(headers, 1)] = False, False
    measured = np.repeat(np.arange(len(lengths)) % 2 == 1, lengths)
    signed = numbers[is_delta][: np.count_nonzero(measured)]
    pixels = np.zeros(count, np.uint16)
    pixels[measured] = np.cumsum((signed >> 1) ^ -(signed & 1)) & 0xFFFF
    return pixels


def _runs(numbers: list[int], count: int) -> tuple[list[int], list[int]]:
    """Lengths of the runs, zeros and others in turn, and where the numbers that tell two of them begin."""
    lengths, headers = [], []
    at = done = 0
    while done < count:
        if at + 2 > len(numbers):
            raise ValueError(f"it ends at pixel {done} of {count}")
        zeros, run = numbers[at], numbers[at + 1]
        lengths += (zeros, run)
        headers.append(at)
        at += 2 + run
        done += zeros + run
        if done > count or at > len(numbers) or zeros + run == 0:
            raise ValueError(f"its runs do not fit at pixel {done} of {count}")
    return lengths, headers


def _numbers(data: NDArray[np.uint8]) -> NDArray[np.int64]:
    """All numbers of a stream; the fill of the last word gives zeros at its end."""
    upper_first = data[: data.size // 4 * 4].reshape(-1, 4)[:, ::-1].ravel()
    groups = np.stack([upper_first >> 4, upper_first & 15], axis=1).ravel()
    ends = np.flatnonzero(groups < 8)
    if not ends.size:
        return np.zeros(0, np.int64)
    starts = np.concatenate([[0], ends[:-1] + 1])
    groups = groups[: ends[-1] + 1].astype(np.int64)
    place = np.arange(groups.size) - np.repeat(starts, ends - starts + 1)
    if place.max() > 10:
        raise ValueError("a number has more than 32 bits")
    return np.add.reduceat((groups & 7) << (3 * place), starts)
