"""Engine: MuJoCo, for the modules that need it; without it their import says which extra brings it."""

from importlib import import_module
from typing import Any

from stmpl_core.extras import needed

needed("a robot in MuJoCo", "sim", "mujoco")
mujoco: Any = import_module("mujoco")  # what its own stubs do not name, type checkers would doubt
