"""The line that stands beside every number: machine, versions, date."""

import datetime
import os
import platform

import jax


def describe_machine() -> str:
    """Device, processor cores, versions and date, in words and without the machine's name."""
    device = jax.devices()[0]
    kind = (
        f"{os.cpu_count()} CPU cores ({platform.machine()})"
        if device.platform == "cpu"
        else f"{len(jax.devices())} x {device.device_kind}"
    )
    return f"{kind}, jax {jax.__version__}, Python {platform.python_version()}, {datetime.date.today()}"
