"""The range error of a sensor, measured on its recordings.

Uses the pipeline as users do, and `signal.spread`. For others: the names below; `error` holds the fit,
`cells` and `views` what it is fitted to.
"""

from rcseg_core.calibration.error import Calibration, calibrate

__all__ = ["Calibration", "calibrate"]
