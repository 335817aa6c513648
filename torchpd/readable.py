"""A model whose contacts, pins and stress can be read out, and written to files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from torch import Tensor

from .adjoint import AdjointCall
from .checks import check_like
from .diagonal import named_material
from .material import check_environments
from .model import Model
from .readouts import ContactForces, Reactions, contact_forces, reactions
from .state import State
from .stress import Stress, stress, vertex_average
from .targets import Targets
from .vtu import States, write_vtu

__all__ = ["Readable"]


class Readable(Model):
    """What a `Simulator` tells about steps and states; docs/readouts.md is a guide."""

    def checked_call(
        self, state: State, after: State | Tensor, forces: Tensor | None, targets: Targets | None
    ) -> AdjointCall:
        """The step from a state to the positions `after`, all arguments checked."""
        forces = self.check_state(state, forces=forces)
        before, positions = self.positions_of(state), self.positions_of(after, "after")
        check_like("after", positions, before, "m")
        material = self.material_at(targets, len(before))
        check_environments("state", len(before), named_material(material))
        return AdjointCall(before, state[1], forces, positions, material, list(self.plan.arrays), self.time_step)

    def contact_forces(
        self,
        state: State,
        after: State | Tensor,
        forces: Tensor | None = None,
        targets: Targets | None = None,
        *,
        about: Tensor | None = None,
    ) -> ContactForces:
        """Forces of grounds and spheres on the vertices in the step from `state` to `after` [N].

        They are what the gradient of the step's objective leaves at `after`: pushes along the normals, and friction up
        to Coulomb's bound. Where several colliders hold a vertex, the pushes fit the gradient best, and friction is
        shared; `torchpd.readouts` states the rule. What no contact and no pin balances is `residual`: compare it with
        the forces to see how far to trust them. Hard pins take all at their vertices. Differentiable.

        Args:
            state: where the step started.
            after: where it ended, a `State` or positions [B, V, 3].
            forces: as in `forward`, the same as in that step.
            targets: as in `forward`, the same as in that step.
            about: point of torques [3] or [B, 3] [m]; by default the centre of mass of each body at `after`.

        Returns:
            Forces of all colliders [B, V, 3], and of each: `contacts.colliders[ground].force`. Sums and torques by
            body: `contacts.bodies[solid].force` [B, 3]. `colliders` is empty where the scene has none.

        Example:
            >>> after = sim(state)
            >>> contacts = sim.contact_forces(state, after)
            >>> contacts.bodies[cube].force  # [B, 3] N, of a cube at rest its weight, upwards
        """
        return contact_forces(self.scene, self.checked_call(state, after, forces, targets), about)

    def reactions(
        self,
        state: State,
        after: State | Tensor,
        forces: Tensor | None = None,
        targets: Targets | None = None,
        *,
        about: Tensor | None = None,
    ) -> Reactions:
        """Forces of pins on their vertices in the step from `state` to `after` [N].

        The force of a hard pin is the gradient of the step's objective without pins, that of a soft one
        k (target - x'). The force of a hard pin therefore includes what contacts would do to its vertices, and what an
        unsolved step leaves there; `ContactForces.residual` has that of the other vertices. Differentiable.

        Args:
            state, after, forces, targets, about: as in `contact_forces`.

        Returns:
            Forces in the order of `pin_targets` [B, P, 3] and on all vertices [B, V, 3], and by pin:
            `reactions.pins[pin].wrench.force` [B, 3] is what it carries. `pins` is empty where the scene has none.
        """
        return reactions(self.scene, self.checked_call(state, after, forces, targets), about)

    def stress(self, state: State | Tensor) -> Stress:
        """Cauchy stress [B, E, 3, 3] and von Mises stress [B, E] [Pa] of every tetrahedron, and its strain.

        sigma = w (F - R) F^T / det F, w Young's modulus, F the deformation gradient and R its nearest rotation. NaN
        where det F > 0 fails, see `Stress.inverted`. Differentiable.

        Args:
            state: a `State`, or positions [B, V, 3].
        """
        positions, stiffness = self.positions_of(state), self.stiffness
        check_environments("state", len(positions), {"stiffness": stiffness})
        return stress(self.scene, positions, stiffness)

    def vertex_average(self, values: Tensor) -> Tensor:
        """Average at every vertex of what its tetrahedra have, weighted by their rest volumes. Differentiable.

        For colours and contours of a field that jumps between tetrahedra, such as `stress(state).von_mises`. A vertex
        of an inverted tetrahedron, whose stress is NaN, has NaN.

        Args:
            values: of tetrahedra [B, E, ...].

        Returns:
            [B, V, ...], in the unit of the values.
        """
        return vertex_average(self.scene, values, self.rest_positions)

    def write_vtu(
        self,
        path: str | Path,
        states: States,
        *,
        environment: int | None = None,
        times: Sequence[float] | None = None,
        point_data: Mapping[str, Any] | None = None,
        cell_data: Mapping[str, Any] | None = None,
    ) -> Path:
        """Write a state as `.vtu` for ParaView; a track or a list of states as a `.pvd` with a numbered `.vtu` each.

        Displacement, velocity, stress, von Mises stress and body are always there, regions where meshes have some; see
        `torchpd.vtu` for their names.

        Args:
            path: of the .vtu, or of the .pvd, beside which the others go; existing files are replaced.
            states: what to write.
            environment: which one; needed where states have several.
            times: of the records [s]; by default those of a rollout that records every step, h, 2 h, ...
            point_data: more fields by name, of vertices: [B, V, ...], of several states [T, B, V, ...]; or [V, ...] for
                all of them. Tensors or arrays.
            cell_data: the same of tetrahedra, E for V.

        Returns:
            The path.
        """

        def check(state: State) -> None:
            self.check_state(state)
            self.positions_of(state)

        return write_vtu(self.compiled, check, path, states, environment, times, point_data, cell_data)
