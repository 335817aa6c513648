"""What is simulated: bodies, pins, obstacles, solver settings, as immutable values."""

from .scene import Part, Scene, SceneValues

__all__ = ["Part", "Scene", "SceneValues"]
