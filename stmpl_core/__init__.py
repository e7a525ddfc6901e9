"""The core: bodies, layers, charts, contacts and the methods that solve them. Knows no ROS and no FEM."""

from stmpl_core.contact import Contact, ToolMesh
from stmpl_core.layer import SoftLayer, Tissue
from stmpl_core.load import Load
from stmpl_core.trust import Displacement, Trust

__all__ = ["Contact", "Displacement", "Load", "SoftLayer", "Tissue", "ToolMesh", "Trust"]
