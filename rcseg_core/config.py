"""Every parameter of the algorithm: one frozen group a stage, one line a parameter.

This file is the only place that holds a default, a unit, a bound or a paper symbol. YAML files, ROS
parameters, ``--set group.name=value`` and the reference in ``rcseg config`` are all derived from it by
`describe`. Where the default departs from the paper, the literal form is one of the choices
(`SegmenterConfig.literal`).
"""

from __future__ import annotations

import dataclasses
import difflib
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any, Literal

from rcseg_core.errors import ConfigError

#: What YAML and shells write for a boolean.
TRUE_WORDS, FALSE_WORDS = ("true", "yes", "on", "1"), ("false", "no", "off", "0")

#: What each preset changes; "balanced" is the default itself.
PRESETS: Mapping[str, Mapping[str, Any]] = {
    "fast": {"signal.reduction": 2, "grouping.order": "joint"},
    "balanced": {},
    "accurate": {"absorption.refine_passes": 4},
}


@dataclass(frozen=True)
class Parameter:
    """One parameter as users see it: key, value, default, type, unit, bounds or choices, symbol, text."""

    key: str
    value: Any
    default: Any
    type: type
    unit: str
    low: float | None
    high: float | None
    choices: tuple[str, ...]
    symbol: str
    doc: str


def _param(
    default: Any,
    doc: str,
    *,
    unit: str = "",
    low: float | None = None,
    high: float | None = None,
    choices: tuple[str, ...] = (),
    symbol: str = "",
) -> Any:
    meta = {"doc": doc, "unit": unit, "low": low, "high": high, "choices": choices, "symbol": symbol}
    return field(default=default, metadata=meta)


@dataclass(frozen=True)
class SignalConfig:
    """Which range signal is modelled (section 2)."""

    kind: Literal["auto", "inverse_depth", "xyz"] = _param(
        "auto",
        "auto: inverse depth where a camera model is known or the rays of the grid pass through one point, "
        "else x, y, z (the paper)",
        choices=("auto", "inverse_depth", "xyz"),
        symbol="eta_r",
    )
    reduction: int = _param(
        1,
        "side of the squares of pixels that are averaged first; labels come back at full size. "
        "1: none; 2 takes a third of the time and misses what is only a few pixels wide",
        unit="px", low=1, high=4,
    )  # fmt: skip


@dataclass(frozen=True)
class NoiseConfig:
    """Sigma_r and Sigma_c of eq. (3)."""

    range_model: Literal["auto", "constant", "law", "kinect_v1", "realsense_d435"] = _param(
        "auto",
        "auto: estimated from each frame as a function of depth; constant: range_sigma at every depth; "
        "law: a + b w + c w^2 of inverse depth w, as `rcseg calibrate` writes it; else a sensor",
        choices=("auto", "constant", "law", "kinect_v1", "realsense_d435"),
        symbol="Sigma_r",
    )
    range_prior: Literal["none", "kinect_v1", "realsense_d435"] = _param(
        "none",
        "sensor whose law fills in, for range_model auto and cameras, where a frame has too few smooth "
        "windows to tell",
        choices=("none", "kinect_v1", "realsense_d435"),
    )
    range_sigma: float = _param(
        0.002, "standard deviation along depth, for range_model constant", unit="m", low=1e-7, high=1.0
    )
    range_law_a: float = _param(
        0.002, "part of the standard deviation of inverse depth that no depth changes, for range_model law",
        unit="1/m", low=1e-9, high=10.0,
    )  # fmt: skip
    range_law_b: float = _param(
        0.0, "part of it that grows with inverse depth: an error that is a share of depth", low=0.0, high=1.0
    )
    range_law_c: float = _param(
        0.0, "part of it that grows with the square of inverse depth: constant along depth, time of flight",
        unit="m", low=0.0, high=10.0,
    )  # fmt: skip
    range_correlation: float = _param(
        0.0, "pixels that make one independent measurement of range, 1: white noise; 0: measured from frames",
        unit="px", low=0.0, high=10000.0,
    )  # fmt: skip
    range_systematic: float = _param(
        -1.0, "part of the range error that no number of pixels averages away; -1: measured from frames",
        unit="sigma", low=-1.0, high=100.0,
    )  # fmt: skip
    color_sigma: float = _param(
        0.0,
        "standard deviation of each colour channel; 0: estimated from each frame",
        unit="levels",
        low=0.0,
        high=64.0,
        symbol="Sigma_c",
    )


@dataclass(frozen=True)
class ReflectanceConfig:
    """Colour normalisation (section 3, eq. 4-7)."""

    mode: Literal["none", "active", "calibrated"] = _param(
        "none",
        "none: passive light; active: light at the sensor, eq. (5); calibrated: white-reference frame, "
        "eq. (6)-(7)",
        choices=("none", "active", "calibrated"),
        symbol="rho_lambda",
    )
    min_cosine: float = _param(
        0.2, "the correction is held below this cosine of incidence, where it only amplifies noise",
        low=0.01, high=1.0, symbol="mu.n",
    )  # fmt: skip


@dataclass(frozen=True)
class EdgesConfig:
    """Morphological depth, orientation and colour discontinuities (section 8; Boulanger et al. 1990)."""

    depth_threshold: float = _param(
        10.0, "step of the range signal that is a depth discontinuity, beside depth_step", unit="sigma",
        low=1.0, high=1000.0,
    )  # fmt: skip
    depth_step: float = _param(
        0.02, "least step that is a depth discontinuity", unit="fraction of depth", low=0.0, high=1.0
    )
    orientation_threshold: float = _param(
        5.0, "morphological Laplacian that is an orientation discontinuity", unit="sigma",
        low=1.0, high=1000.0,
    )  # fmt: skip
    orientation_window: int = _param(
        7, "odd window of the morphological Laplacian", unit="px", low=3, high=15
    )
    color_threshold: float = _param(
        40.0, "morphological gradient of one channel that is a colour edge", unit="levels",
        low=1.0, high=255.0,
    )  # fmt: skip
    outlier_threshold: float = _param(
        6.0, "distance from the local median beyond which a pixel is an impulse, not an edge; "
        "0: none are flagged", unit="sigma", low=0.0, high=1000.0,
    )  # fmt: skip


@dataclass(frozen=True)
class SeedsConfig:
    """Initial partition by windows with least median of squares (section 5)."""

    max_window: int = _param(11, "largest window, odd", unit="px", low=3, high=31, symbol="L_max")
    min_window: int = _param(3, "smallest window, odd", unit="px", low=3, high=31, symbol="L_min")
    fit: Literal["auto", "lms"] = _param(
        "auto",
        "lms: every window (the paper); auto: only windows whose least-squares residual is not pure noise",
        choices=("auto", "lms"),
    )
    subsets: int = _param(
        72, "random minimal subsets a window; 72 give 99 % at 50 % outliers", low=1, high=2000
    )
    min_valid: float = _param(
        0.5, "least share of usable pixels in a window", unit="fraction", low=0.1, high=1.0
    )


@dataclass(frozen=True)
class GroupingConfig:
    """Best-first grouping of adjacent regions (section 6, eq. 16-21)."""

    order: Literal["surfaces_first", "joint", "range_only"] = _param(
        "surfaces_first",
        "surfaces_first: surfaces from range alone, then the colour regions on each; joint: both signals at "
        "once (the paper); range_only: surfaces, whatever their colour",
        choices=("surfaces_first", "joint", "range_only"),
    )
    criterion: Literal["bounded", "chow", "bayes"] = _param(
        "bounded",
        "bounded: the joint model must explain both sides; chow: total rise of the residual; bayes: c_ib of "
        "eq. (21)",
        choices=("bounded", "chow", "bayes"),
        symbol="c_ib",
    )
    range_tolerance: float = _param(
        0.004, "approximation limit of the range models",
        unit="fraction of depth (of extent for scanner grids)", low=0.0, high=0.5, symbol="epsilon_t (range)",
    )  # fmt: skip
    color_tolerance: float = _param(
        20.0, "approximation limit of the colour models", unit="levels", low=0.0, high=255.0,
        symbol="epsilon_t (colour)",
    )  # fmt: skip
    intensity_weight: float = _param(
        1.0,
        "weight of brightness beside chromaticity when colours are compared; below 1 shadows, reflections"
        " and light gradients part regions less, and so does grey print; 0.25 to 0.5 for uneven light",
        low=0.1, high=1.0,
    )  # fmt: skip
    relief_tolerance: float = _param(
        0.1, "a curved surface may miss this share of its own relief (rms about a plane), where that is more",
        unit="fraction of relief", low=0.0, high=1.0,
    )  # fmt: skip
    noise_share: float = _param(
        0.4, "systematic part of the noise that more pixels do not average away", unit="sigma",
        low=0.0, high=10.0,
    )  # fmt: skip
    edge_gate: bool = _param(
        True, "scale the tolerance by the share of the common boundary that crosses no detected edge"
    )
    max_gap: int = _param(
        3,
        "regions at most this far apart are adjacent: missing pixels up to this width do not part a surface",
        unit="px",
        low=1,
        high=15,
    )
    prior_beta: float = _param(
        1.0, "strength of the belief in the coefficients, for criterion bayes", unit="sigma",
        low=1e-6, high=1e6, symbol="beta",
    )  # fmt: skip


@dataclass(frozen=True)
class GeneralizationConfig:
    """Degrees that grow only when the statistics demand it (section 7, eq. 22-23)."""

    hypothesis: Literal["pair", "region"] = _param(
        "pair",
        "pair: a higher degree is tried on the union of two regions; region: on each region alone (the "
        "paper)",
        choices=("pair", "region"),
    )
    test: Literal["guarded", "f"] = _param(
        "guarded",
        "guarded: a degree must gain more than correlated and systematic error explain; f: the nested F test "
        "alone (the paper)",
        choices=("guarded", "f"),
    )
    alpha: float = _param(
        0.1, "level of the F test, for test f", unit="probability", low=1e-6, high=0.5, symbol="alpha"
    )
    creases: bool = _param(
        True, "divide a bent surface where two that meet along a line explain it better (surfaces by range)"
    )
    max_range_degree: int = _param(4, "highest degree of the range patches", low=1, high=4, symbol="k")
    max_color_degree: int = _param(2, "highest degree of the colour patches", low=1, high=4, symbol="k")


@dataclass(frozen=True)
class AbsorptionConfig:
    """Single pixels join the region that predicts them (section 2, step 3: 'or points')."""

    enabled: bool = _param(True, "absorb unassigned pixels into adjacent regions")
    max_cost: float = _param(
        16.0, "largest squared residual of an absorbed pixel", unit="sigma^2 (noise and half the tolerance)",
        low=0.0, high=1e6,
    )  # fmt: skip
    min_region: int = _param(
        30, "smaller leftovers join a neighbour instead of becoming a region", unit="px at 640x480", low=1,
        high=10000,
    )  # fmt: skip
    speck: int = _param(
        200, "regions below this whose pixels a neighbour predicts dissolve into it", unit="px at 640x480",
        low=1, high=100000,
    )  # fmt: skip
    small_region: int = _param(
        500, "regions below this are absorbed whole where a neighbour predicts them within the tolerance",
        unit="px at 640x480", low=0, high=100000,
    )  # fmt: skip
    refine_passes: int = _param(
        2, "passes in which boundary pixels move to the neighbour that predicts them better", low=0, high=20
    )


@dataclass(frozen=True)
class BordersConfig:
    """Where surfaces end (Boulanger, Osorio & Prieto 2005)."""

    sharpen: bool = _param(True, "borders of surfaces that meet lie where their models intersect")
    reach: int = _param(
        4, "borders at most this far from the intersection move to it", unit="px", low=1, high=50
    )
    flying: Literal["color", "nearest", "unassigned"] = _param(
        "color",
        "pixels in mid-air at a step of depth; color: join the side that has their colour; nearest: the side "
        "that is nearer to their range; unassigned: none (label 0)",
        choices=("color", "nearest", "unassigned"),
    )
    fill_holes_px: int = _param(
        0, "holes of up to this area that one surface surrounds get its label, and depth from its model",
        unit="px", low=0, high=1000000,
    )  # fmt: skip


@dataclass(frozen=True)
class WorldConfig:
    """What a robot takes from the surfaces: up, classes, ground, polygons, objects (docs/world.md)."""

    up_from: Literal["floor", "parameter", "tf", "imu", "none"] = _param(
        "floor",
        "where up is known from; floor: the largest low plane that fits; parameter: up_x, up_y, up_z; tf, "
        "imu: whoever calls tells it frame by frame (the node does), unknown until then; none: unknown",
        choices=("floor", "parameter", "tf", "imu", "none"),
    )
    up_x: float = _param(
        0.0, "up in the sensor's frame, of any length, for up_from parameter", low=-1e6, high=1e6
    )
    up_y: float = _param(-1.0, "its y; the optical frame's y points down", low=-1e6, high=1e6)
    up_z: float = _param(0.0, "its z", low=-1e6, high=1e6)
    up_sigma: float = _param(
        0.01, "standard deviation of the two tilts of an up that is told without one", unit="rad", low=0.0,
        high=1.0,
    )  # fmt: skip
    horizontal_limit: float = _param(
        10.0, "planes tilted less than this are horizontal or ceilings, and vertical beside the upright",
        unit="deg", low=0.1, high=44.0,
    )  # fmt: skip
    floor_tolerance: float = _param(
        0.02, "horizontal planes this near to the floor's own plane are floor", unit="m", low=0.0, high=10.0
    )
    tilt_limit: float = _param(
        2.0, "tilt between told up and seen floor that is named, where it is beyond three deviations too",
        unit="deg", low=0.0, high=90.0,
    )  # fmt: skip
    step_height: float = _param(
        0.05, "steps up to this can be taken; what stands out from the ground by less is ground", unit="m",
        low=0.0, high=10.0,
    )  # fmt: skip
    slope_limit: float = _param(15.0, "inclines up to this can be taken", unit="deg", low=0.0, high=60.0)
    polygon_tolerance: float = _param(
        0.005, "polygons are simplified by at most this distance", unit="m", low=0.0, high=10.0
    )
    polygon_least: int = _param(
        25, "parts and holes of a boundary of fewer pixels are left out", unit="px", low=1, high=1000000
    )
    support_area: float = _param(
        0.35,
        "horizontal planes larger than this are support, no objects; and planes of any tilt with nothing "
        "behind them, or of four times this", unit="m^2",
        low=0.0, high=1e6,
    )  # fmt: skip


@dataclass(frozen=True)
class TrackingConfig:
    """Names that last from frame to frame; of these, only `stability` changes how a frame is segmented."""

    cell_px: int = _param(
        6, "side of the squares of pixels of which one is carried from frame to frame", unit="px at 640x480",
        low=1, high=64,
    )  # fmt: skip
    min_overlap: float = _param(
        0.15, "least intersection over union of the visible part at which a label keeps a name",
        unit="fraction", low=0.01, high=1.0,
    )  # fmt: skip
    depth_tolerance: float = _param(
        0.04, "by which a carried point may miss the surface it falls on; farther, it is hidden or has gone",
        unit="fraction of depth", low=0.001, high=1.0,
    )  # fmt: skip
    gate: float = _param(
        1e-5, "probability below which two planes, spheres or cylinders are not the same (chi-squared)",
        unit="probability", low=1e-12, high=0.5,
    )  # fmt: skip
    slack_m: float = _param(
        0.01, "one sigma of what a surface may move between two frames, beside its errors", unit="m", low=0.0,
        high=10.0,
    )  # fmt: skip
    slack_rad: float = _param(
        0.01, "one sigma of what a surface may turn between two frames, beside its errors", unit="rad",
        low=0.0, high=1.0,
    )  # fmt: skip
    color_weight: float = _param(
        0.1, "what equal colour adds to the overlap of two candidates", unit="fraction", low=0.0, high=1.0
    )
    pose_sigma_m: float = _param(
        0.0, "error of the poses that are given, in each direction and independent from frame to frame",
        unit="m", low=0.0, high=10.0,
    )  # fmt: skip
    pose_sigma_rad: float = _param(0.0, "error of their rotation, likewise", unit="rad", low=0.0, high=1.0)
    margin_px: int = _param(
        6, "places around a carried point that count too where no motion is known", unit="px at 640x480",
        low=0, high=100,
    )  # fmt: skip
    confirm_frames: int = _param(
        3, "frames that must show a track before it is confirmed; a tentative one is forgotten when so many "
        "do not show it", unit="frames", low=1, high=1000,
    )  # fmt: skip
    keep_lost_s: float = _param(
        30.0, "time after which a lost track is forgotten", unit="s", low=0.0, high=1e9
    )
    max_lost: int = _param(
        256, "lost tracks of each kind that are remembered; the longest lost go first", low=0, high=100000
    )
    stability: float = _param(
        0.0, "by how much limits move in favour of what the last frame decided; 0: every frame stands alone",
        unit="fraction of the limit", low=0.0, high=100.0,
    )  # fmt: skip
    max_gap_s: float = _param(
        1.0, "time without a frame after which all tracks end, unless a pose tells where the sensor went",
        unit="s", low=0.0, high=1e9,
    )  # fmt: skip


@dataclass(frozen=True)
class SegmenterConfig:
    """The whole configuration. Frozen; variants come from `replace`, `from_dict` or `dataclasses.replace`."""

    signal: SignalConfig = SignalConfig()
    noise: NoiseConfig = NoiseConfig()
    reflectance: ReflectanceConfig = ReflectanceConfig()
    edges: EdgesConfig = EdgesConfig()
    seeds: SeedsConfig = SeedsConfig()
    grouping: GroupingConfig = GroupingConfig()
    generalization: GeneralizationConfig = GeneralizationConfig()
    absorption: AbsorptionConfig = AbsorptionConfig()
    borders: BordersConfig = BordersConfig()
    world: WorldConfig = WorldConfig()
    tracking: TrackingConfig = TrackingConfig()

    def __post_init__(self) -> None:
        for parameter in describe(self):
            _check(parameter)
        if self.seeds.min_window > self.seeds.max_window:
            raise ConfigError(
                f"seeds.min_window = {self.seeds.min_window} is larger than "
                f"seeds.max_window = {self.seeds.max_window}"
            )
        up = self.world
        if up.up_from == "parameter" and not any((up.up_x, up.up_y, up.up_z)):
            raise ConfigError("world.up_x, up_y, up_z = 0, 0, 0: expected a vector that points somewhere")

    @classmethod
    def preset(cls, name: str) -> SegmenterConfig:
        """A named trade of accuracy for time: "fast", "balanced" (the defaults) or "accurate".

        Raises
        ------
        ConfigError
            For another name; the message lists the names.
        """
        if not isinstance(name, str) or name not in PRESETS:
            raise ConfigError(f"preset = {name!r}: expected one of {', '.join(PRESETS)}")
        return cls().replace(PRESETS[name])

    @classmethod
    def from_dict(cls, nested: Mapping[str, Any], base: SegmenterConfig | None = None) -> SegmenterConfig:
        """`base` (the defaults if None) overridden by a nested mapping {group: {name: value}}.

        Raises
        ------
        ConfigError
            Unknown key, wrong type or value out of bounds; names the key, the value and what is allowed.
        """
        flat: dict[str, Any] = {}
        if not isinstance(nested, Mapping):
            raise ConfigError(f"a configuration is a mapping of groups, got {type(nested).__name__}")
        for group, values in nested.items():
            if not isinstance(values, Mapping):
                raise ConfigError(f"{group}: expected a mapping of parameters, got {values!r}")
            for name, value in values.items():
                flat[f"{group}.{name}"] = value
        return (base or cls()).replace(flat)

    def replace(self, changes: Mapping[str, Any]) -> SegmenterConfig:
        """A copy with some dotted keys changed, for example ``{"grouping.range_tolerance": 0.004}``.

        Strings are converted to the parameter's type, so that ``--set`` values can be passed as they come.

        Raises
        ------
        ConfigError
            Unknown key, wrong type or value out of bounds.
        """
        known = {p.key: p for p in describe(self)}
        groups: dict[str, dict[str, Any]] = {}
        for key, value in changes.items():
            if key not in known:
                near = difflib.get_close_matches(key, known, n=1)
                hint = f"; did you mean {near[0]}?" if near else "; `rcseg config` lists all parameters"
                raise ConfigError(f"unknown parameter {key}{hint}")
            group, name = key.split(".")
            groups.setdefault(group, {})[name] = _convert(known[key], value)
        return dataclasses.replace(
            self, **{g: dataclasses.replace(getattr(self, g), **values) for g, values in groups.items()}
        )

    def to_dict(self) -> dict[str, dict[str, Any]]:
        """Nested plain values, the inverse of `from_dict`."""
        return dataclasses.asdict(self)

    @classmethod
    def literal(cls) -> SegmenterConfig:
        """The paper's own choices wherever the default departs from them."""
        return cls().replace(
            {
                "signal.kind": "xyz",
                "grouping.order": "joint",
                "seeds.fit": "lms",
                "grouping.criterion": "bayes",
                "grouping.edge_gate": False,
                "generalization.hypothesis": "region",
                "generalization.test": "f",
                "borders.sharpen": False,
                "borders.flying": "nearest",
                "generalization.creases": False,
            }
        )


def describe(config: SegmenterConfig) -> list[Parameter]:
    """Every parameter of `config` in file order, with its default, type, unit, bounds, symbol and text."""
    out = []
    for group in fields(SegmenterConfig):
        values = getattr(config, group.name)
        for f in fields(values):
            out.append(
                Parameter(
                    key=f"{group.name}.{f.name}",
                    value=getattr(values, f.name),
                    default=f.default,
                    type=type(f.default),
                    **f.metadata,
                )
            )
    return out


def _convert(parameter: Parameter, value: Any) -> Any:
    """`value` as the parameter's type: text is parsed, an integer may stand for a float."""
    kind = parameter.type
    if isinstance(value, str) and kind is bool:
        if value.lower() in TRUE_WORDS + FALSE_WORDS:
            return value.lower() in TRUE_WORDS
    elif isinstance(value, str) and kind in (int, float):
        try:
            return kind(value)
        except ValueError:
            pass
    elif kind is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    elif type(value) is kind:
        return value
    raise ConfigError(f"{parameter.key} = {value!r}: expected {_expected(parameter)}")


def _expected(parameter: Parameter) -> str:
    if parameter.choices:
        return "one of " + ", ".join(parameter.choices)
    if parameter.type is bool:
        return "true or false"
    unit = f" {parameter.unit}" if parameter.unit else ""
    odd = "an odd " if parameter.key.endswith("_window") else "a "
    kind = "whole number" if parameter.type is int else "number"
    return f"{odd}{kind} from {parameter.low} to {parameter.high}{unit}"


def _check(parameter: Parameter) -> None:
    value = parameter.value
    bad = type(value) is not parameter.type
    if not bad and parameter.choices:
        bad = value not in parameter.choices
    elif not bad and parameter.type in (int, float):
        bad = not (parameter.low <= value <= parameter.high)  # NaN fails too
        bad = bad or (parameter.key.endswith("_window") and value % 2 == 0)
    if bad:
        raise ConfigError(f"{parameter.key} = {value!r}: expected {_expected(parameter)}")
