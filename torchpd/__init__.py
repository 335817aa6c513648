"""torchpd: elastic bodies by projective dynamics, as PyTorch operators."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from .common.extension import extension_error, load_extension
from .common.synonyms import no_attribute
from .common.warn import SceneWarning, TuningWarning
from .geometry import shapes
from .geometry.embedding import Embedding
from .geometry.tet_mesh import MeshWarning, TetMesh, embed
from .geometry.tetrahedralize import tetrahedralize
from .geometry.tri_mesh import TriMesh
from .scene.cloth import Cloth
from .scene.contact import Collider, Contact
from .scene.effects import Damping, Gravity, Ground, Pin, Solid, Sphere
from .scene.fibres import Fibres
from .scene.loads import Pressure, Wind
from .scene.plastic import Plastic
from .scene.rod import Rod
from .scene.scene import Scene
from .scene.solvers import Chebyshev, Jacobi, Multilevel, Newton
from .scene.springs import Springs
from .scene.tie import Tie
from .simulation.state import ContactHistory, History, HistoryState, HistoryTrack, Info, State, Track
from .version import __version__

if load_extension()[0] is not None:
    from .accuracy.spectral_radius import estimate_rho
    from .api.patches import FreeFormPatches, PatchFit, PatchRays, fit_patches
    from .api.simulator import Simulator
    from .estimate.convergence import UnsolvedWarning
    from .freeform.body import PatchBody
    from .freeform.fit import FitReport
    from .freeform.image import PatchImage
    from .freeform.loss import PatchLoss
    from .freeform.quadric_transport import QuadricTransport
    from .freeform.quadrics import Quadrics
    from .freeform.rays import PatchHits
    from .freeform.surface import PatchPose, PatchSamples
    from .freeform.transport import PatchTransport
    from .ops.registration import nearest_rotation
    from .plan.cpu_plan import Plan, compile_plan
    from .simulation.cuda_graph import CapturedStep
    from .simulation.distributed import keep_material_per_rank
    from .simulation.readouts import ContactForces, Reactions
    from .simulation.stencil_readouts import MembraneStress, Tension
    from .simulation.stress import Stress
__all__ = [
    "CapturedStep",
    "Chebyshev",
    "Cloth",
    "Collider",
    "Contact",
    "ContactForces",
    "ContactHistory",
    "Damping",
    "Embedding",
    "Fibres",
    "FitReport",
    "FreeFormPatches",
    "Gravity",
    "Ground",
    "History",
    "HistoryState",
    "HistoryTrack",
    "Info",
    "Jacobi",
    "MembraneStress",
    "MeshWarning",
    "Multilevel",
    "Newton",
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
    "Plastic",
    "Pressure",
    "QuadricTransport",
    "Quadrics",
    "Reactions",
    "Rod",
    "Scene",
    "SceneWarning",
    "Simulator",
    "Solid",
    "Sphere",
    "Springs",
    "State",
    "Stress",
    "Tension",
    "TetMesh",
    "Tie",
    "Track",
    "TriMesh",
    "TuningWarning",
    "UnsolvedWarning",
    "Wind",
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
