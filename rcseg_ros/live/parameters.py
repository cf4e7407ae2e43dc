"""Configuration as ROS parameters: declared by one walk over the config, checked by the config itself.

The config is frozen and replaced as a whole, so the worker, which reads `config` once a frame, sees a
change of one parameter or of a whole atomic set between two frames or not at all. What the config refuses
is refused with its words.
"""

from __future__ import annotations

import dataclasses
import difflib
from collections.abc import Callable
from typing import Any

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, SetParametersResult
from rclpy.exceptions import InvalidParameterTypeException, InvalidParameterValueException
from rclpy.node import Node
from rclpy.parameter import Parameter as RosParameter

from rcseg_core import SegmenterConfig
from rcseg_core.config import Parameter, describe
from rcseg_core.errors import ConfigError
from rcseg_ros.options import (
    LIVE_NODE_PARAMETERS,
    NODE_PARAMETERS,
    READ_ONLY,
    all_parameters,
    allowed,
    refusal,
)

_FOREIGN = ("qos_overrides", "use_sim_time", "start_type_description_service")


class NodeParameters:
    """All parameters of a node, declared on construction.

    Parameters
    ----------
    node : the node that carries them
    is_unconfigured : tells whether parameters that are read at configure may change now

    Raises
    ------
    ConfigError
        If a file or the command line gives a value of a wrong type or out of bounds.
    """

    def __init__(self, node: Node, is_unconfigured: Callable[[], bool]) -> None:
        self._node = node
        self._is_unconfigured = is_unconfigured
        self._types = {p.key: p.type for p in all_parameters()}
        overrides = getattr(node, "_parameter_overrides", {})
        for key, given in overrides.items():
            overrides[key] = self._as_declared(given)
        node.add_pre_set_parameters_callback(lambda changes: [self._as_declared(c) for c in changes])
        for parameter in NODE_PARAMETERS:
            _declare(node, parameter)
        for parameter in describe(SegmenterConfig.preset(self["preset"])):
            _declare(node, dataclasses.replace(parameter, default=parameter.value))  # overrides go before it
        reason = self._refusal({p.key: self[p.key] for p in NODE_PARAMETERS})
        if reason:
            raise ConfigError(reason)
        self.config = self._build_config()
        node.add_on_set_parameters_callback(self._on_set)
        node.add_post_set_parameters_callback(self._after_set)

    def __getitem__(self, key: str) -> Any:
        return self._node.get_parameter(key).value

    def unknown(self) -> list[str]:
        """One sentence for each override that names no parameter: ROS itself would ignore it silently."""
        known = [p.key for p in all_parameters()]
        sentences = []
        for key in getattr(self._node, "_parameter_overrides", {}):
            if key not in known and not key.startswith(_FOREIGN):
                near = difflib.get_close_matches(key, known, n=1)
                sentences.append(
                    f"unknown parameter {key} is ignored" + (f"; did you mean {near[0]}?" if near else "")
                )
        return sentences

    def _as_declared(self, given: RosParameter) -> RosParameter:
        """A whole number for a number with a point, as users write it, and the other way round."""
        kind, value = self._types.get(given.name), given.value
        if kind is float and type(value) is int:
            return RosParameter(given.name, RosParameter.Type.DOUBLE, float(value))
        if kind is int and type(value) is float and value.is_integer():
            return RosParameter(given.name, RosParameter.Type.INTEGER, int(value))
        if kind is tuple and given.type_ == RosParameter.Type.INTEGER_ARRAY:
            return RosParameter(given.name, RosParameter.Type.DOUBLE_ARRAY, [float(v) for v in value])
        return given

    def _build_config(self) -> SegmenterConfig:
        return SegmenterConfig().replace({p.key: self[p.key] for p in describe(SegmenterConfig())})

    def _on_set(self, changes: list[Any]) -> SetParametersResult:
        """Check a whole set together: all of it is taken, or all refused with the reason."""
        reason = self._refusal({change.name: change.value for change in changes})
        return SetParametersResult(successful=not reason, reason=reason)

    def _refusal(self, changes: dict[str, Any]) -> str:
        of_algorithm = {p.key for p in describe(SegmenterConfig())}
        for parameter in NODE_PARAMETERS:
            reason = refusal(parameter, changes.get(parameter.key, parameter.default))
            if reason:
                return reason
        try:
            current = {key: self[key] for key in of_algorithm}
            SegmenterConfig().replace({**current, **{k: v for k, v in changes.items() if k in of_algorithm}})
        except ConfigError as error:
            return str(error)
        fixed = {p.key for p in NODE_PARAMETERS} - LIVE_NODE_PARAMETERS
        late = sorted(key for key in changes if key in fixed)
        if late and not self._is_unconfigured():
            return f"{', '.join(late)}: read at configure; deactivate and clean up the node first"
        return ""

    def _after_set(self, changes: list[Any]) -> None:
        self.config = self._build_config()


def _declare(node: Node, parameter: Parameter) -> None:
    default = list(parameter.default) if isinstance(parameter.default, tuple) else parameter.default
    try:
        node.declare_parameter(parameter.key, default, _descriptor(parameter))
    except (InvalidParameterTypeException, InvalidParameterValueException) as error:
        given = node._parameter_overrides[parameter.key].value  # the exceptions do not all carry it
        kind = "list of numbers" if parameter.type is tuple else parameter.type.__name__
        raise ConfigError(f"{parameter.key} = {given!r}: expected {kind} {allowed(parameter)}") from error


def _descriptor(parameter: Parameter) -> ParameterDescriptor:
    symbol = f" [paper: {parameter.symbol}]" if parameter.symbol else ""
    unit = f" [{parameter.unit}]" if parameter.unit else ""
    descriptor = ParameterDescriptor(description=f"{parameter.doc}{unit}{symbol}")
    descriptor.read_only = parameter.key in READ_ONLY
    descriptor.dynamic_typing = parameter.type is float and bool(parameter.choices)  # a number or a word
    if parameter.choices:
        descriptor.additional_constraints = "one of: " + ", ".join(parameter.choices)
    if parameter.type is int and parameter.low is not None:
        descriptor.integer_range = [
            IntegerRange(from_value=int(parameter.low), to_value=int(parameter.high or 0), step=1)
        ]
    elif parameter.type is float and parameter.low is not None:
        descriptor.floating_point_range = [
            FloatingPointRange(
                from_value=float(parameter.low), to_value=float(parameter.high or 0.0), step=0.0
            )
        ]
    return descriptor
