"""Contact between bodies and with themselves: the reference of the compiled step, in PyTorch."""

from .crossings import crossings, linking_number
from .scene import Collider, ContactHistory, ContactScene, contact_scene
from .step import ContactStep, contact_step

__all__ = [
    "Collider",
    "ContactHistory",
    "ContactScene",
    "ContactStep",
    "contact_scene",
    "contact_step",
    "crossings",
    "linking_number",
]
