"""The former place of the tools, which names the present one to those who import from it."""

raise ImportError(
    "greenroof_ros.common is now greenroof_ros.base: import Parameter from "
    "greenroof_ros.base.parameter, and ConfigurationError from greenroof_ros.base.errors"
)
