"""Settings: a NodeConfig as the parameters of a node, declared with what its fields say and checked whenever set."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from difflib import get_close_matches
from typing import Any, get_args

from pydantic import ValidationError
from pydantic.fields import FieldInfo
from rcl_interfaces.msg import FloatingPointRange, ParameterDescriptor, SetParametersResult
from rclpy.exceptions import InvalidParameterTypeException, InvalidParameterValueException
from rclpy.lifecycle import LifecycleNode
from rclpy.parameter import Parameter
from stmpl_msgs.srv import SetBody

from stmpl_core.errors import InvalidInput, sentence_of
from stmpl_ros.parameters import ANY_TIME, CONFIGURING, Names, NodeConfig

WHEN = {
    "any time": "A running node takes it over at once.",
    "configuring": "Counts when the node is configured.",
    "starting": "Counts from the start.",
}


class Settings:
    """The settings as they are now.

    Args:
        node: node that declares them.
        config: values, which ROS overrides.
        on_change: callback with the new settings once a running node took some over.
        check: function that raises InvalidInput for settings of another part, if there is no such part.

    Attributes:
        config: settings as they are now.
        locked: flag of a configured node, in which what counts then cannot be set.

    Raises:
        InvalidInput: a parameter that ROS overrides with what its field does not allow.
    """

    def __init__(self, node: LifecycleNode, config: NodeConfig, on_change: Callable[[NodeConfig], None],
                 check: Callable[[NodeConfig], None] = lambda config: None) -> None:  # fmt: skip
        self._node, self._on_change, self._check_part = node, on_change, check
        self.locked = False
        values = {}
        for name, field in NodeConfig.model_fields.items():
            try:
                declared = node.declare_parameter(name, _told(getattr(config, name)), described(field))
            except (InvalidParameterValueException, InvalidParameterTypeException) as error:
                raise InvalidInput(f"parameter {name}: {error}") from error
            values[name] = declared.value
        self.config = checked(values)
        self._tell_of_unknown()
        node.add_on_set_parameters_callback(self._check)
        node.add_post_set_parameters_callback(self._take)

    def with_(self, **changes: Any) -> NodeConfig:
        """The settings with `changes`. Raises InvalidInput."""
        return checked(self.config.model_dump() | changes)

    def take(self, config: NodeConfig) -> None:
        """Sets the parameters to what a running node answers with by now."""
        locked, self.locked = self.locked, False
        try:
            changed = {k: v for k, v in config.model_dump().items() if getattr(self.config, k) != v}
            self._node.set_parameters([Parameter(name, value=_told(value)) for name, value in changed.items()])
        finally:
            self.locked = locked

    def _tell_of_unknown(self) -> None:
        """A line for each parameter that somebody gave and nobody declared, which rclpy ignores in silence."""
        for name in sorted(self._node._parameter_overrides):
            if not self._node.has_parameter(name) and not name.startswith("qos_overrides."):
                near = get_close_matches(name, NodeConfig.model_fields, 1)
                meant = f" Is {near[0]} meant?" if near else ""
                self._node.get_logger().warning(f"there is no parameter {name}: it is ignored.{meant}")

    def _check(self, parameters: Sequence[Parameter]) -> SetParametersResult:
        changes = self._ours(parameters)
        try:
            config = self.with_(**changes)
            if config.limb != self.config.limb:
                self._check_part(config)
        except InvalidInput as error:
            return SetParametersResult(successful=False, reason=str(error))
        named = changes.keys() & NodeConfig.names(CONFIGURING)
        late = sorted(name for name in named if getattr(config, name) != getattr(self.config, name))
        if late and self.locked:
            served = set(late) <= SetBody.Request.get_fields_and_field_types().keys()
            how = "call ~/set_body, or clean up first" if served else "clean up first"
            reason = f"a configured node takes no other {', '.join(late)} as a parameter: {how}."
            return SetParametersResult(successful=False, reason=reason)
        return SetParametersResult(successful=True)

    def _take(self, parameters: Sequence[Parameter]) -> None:
        changes = self._ours(parameters)
        if changes:
            self.config = self.with_(**changes)
            if changes.keys() & NodeConfig.names(ANY_TIME):
                self._on_change(self.config)

    def _ours(self, parameters: Sequence[Parameter]) -> dict[str, Any]:
        return {one.name: one.value for one in parameters if one.name in NodeConfig.model_fields}


def _told(value: Any) -> Any:
    """A setting as a parameter: ROS knows the kind of a list by what is in it, so none is one of an empty text."""
    return (list(value) or [""]) if isinstance(value, tuple) else value


def checked(values: dict[str, Any]) -> NodeConfig:
    """The settings of these values. Raises InvalidInput, which says what is wrong with each."""
    try:
        return NodeConfig(**values)
    except ValidationError as error:
        raise InvalidInput(sentence_of(error)) from error


def described(field: FieldInfo) -> ParameterDescriptor:
    """What `ros2 param describe` says of a field: unit, range, what else holds, and when it counts."""
    extra = field.json_schema_extra
    when = str(extra["when"]) if isinstance(extra, dict) else "starting"
    bounds = {name: getattr(m, name) for m in field.metadata for name in ("gt", "ge", "lt", "le") if hasattr(m, name)}
    constraints = [f"{said} {bounds[name]:g}" for name, said in (("gt", "above"), ("lt", "below")) if name in bounds]
    if field.annotation == Names:
        constraints = ["string[]; one text of several, parted by blanks, is taken too"]
    elif field.annotation not in (str, float, bool):
        constraints = ["one of: " + ", ".join(get_args(field.annotation))]
    span = FloatingPointRange(
        from_value=float(bounds.get("ge", bounds.get("gt", -sys.float_info.max))),
        to_value=float(bounds.get("le", bounds.get("lt", sys.float_info.max))),
    )
    return ParameterDescriptor(
        description=f"{field.description}. {WHEN[when]}",
        additional_constraints="; ".join(constraints),
        floating_point_range=[span] if field.annotation is float else [],
        read_only=when == "starting",
        dynamic_typing=field.annotation == Names,
    )
