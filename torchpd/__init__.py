"""torchpd: elastic bodies by projective dynamics, as PyTorch operators."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from . import shapes
from .effects import Damping, Gravity, Ground, Pin, Solid, Sphere
from .embedding import Embedding
from .extension import extension_error, load_extension
from .mesh import MeshWarning, TetMesh, embed
from .scene import Scene
from .solvers import Chebyshev, Jacobi, Multilevel
from .state import Info, State, Track
from .synonyms import no_attribute
from .tetrahedralize import tetrahedralize
from .tri_mesh import TriMesh
from .version import __version__
from .warn import SceneWarning, TuningWarning

if load_extension()[0] is not None:
    from .capture import CapturedStep
    from .distributed import keep_material_per_rank
    from .forecast import UnsolvedWarning
    from .ops import nearest_rotation
    from .patch_body import PatchBody
    from .patch_fit import FitReport
    from .patch_image import PatchImage
    from .patch_loss import PatchLoss
    from .patch_rays import PatchHits
    from .patch_surface import PatchPose, PatchSamples
    from .patch_transport import PatchTransport
    from .patches import FreeFormPatches, PatchFit, PatchRays, fit_patches
    from .plan import Plan, compile_plan
    from .quadric_transport import QuadricTransport
    from .quadrics import Quadrics
    from .readouts import ContactForces, Reactions
    from .rigid_pieces import RigidPieces
    from .simulator import Simulator
    from .spectrum import estimate_rho
    from .stress import Stress
__all__ = [
    "CapturedStep",
    "Chebyshev",
    "ContactForces",
    "Damping",
    "Embedding",
    "FitReport",
    "FreeFormPatches",
    "Gravity",
    "Ground",
    "Info",
    "Jacobi",
    "MeshWarning",
    "Multilevel",
    "PatchBody",
    "PatchFit",
    "PatchHits",
    "PatchImage",
    "PatchLoss",
    "PatchPose",
    "PatchRays",
    "PatchSamples",
    "PatchTransport",
    "Pin",
    "Plan",
    "QuadricTransport",
    "Quadrics",
    "Reactions",
    "RigidPieces",
    "Scene",
    "SceneWarning",
    "Simulator",
    "Solid",
    "Sphere",
    "State",
    "Stress",
    "TetMesh",
    "Track",
    "TriMesh",
    "TuningWarning",
    "UnsolvedWarning",
    "__version__",
    "compile_plan",
    "embed",
    "estimate_rho",
    "fit_patches",
    "keep_material_per_rank",
    "nearest_rotation",
    "shapes",
    "tetrahedralize",
]

if not TYPE_CHECKING:  # type checkers would take any name for one of ours

    def __getattr__(name: str) -> Any:
        if name in __all__:  # meshes, scenes and the doctor work without the extension
            raise extension_error(name)
        raise no_attribute("", name)

    def __dir__() -> list[str]:
        return [*__all__, *(name for name in globals() if name.startswith("__"))]
