"""Read-outs of a model: contact forces, reactions, stress, tensions, volumes, and files for ParaView."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from ..common.checks import check_like
from ..ops.adjoint import AdjointCall
from ..ops.diagonal import named_material
from ..ops.registration import refuse_forward_mode
from ..plan.material import LOAD_ROWS, check_environments
from ..scene.cloth import Cloth
from ..scene.effects import Solid
from ..scene.fibres import Fibres
from ..scene.part import Body
from ..scene.rod import Rod
from ..scene.springs import Springs
from ..scene.targets import NO_INPUTS, ColliderInputs, Targets
from .model import Model
from .pair_forces import Met, pair_forces
from .readouts import ContactForces, Reactions, contact_forces, reactions
from .state import ContactHistory, HistoryState, State
from .stencil_readouts import MembraneStress, Tension, membrane_stress, tensions
from .stress import STRESS_ROWS, Stress, plastic_strain, stress, vertex_average
from .volume import volumes
from .vtu import States, write_vtu

__all__ = ["Readable"]


class Readable(Model):
    """Read-outs of steps and states of a `Simulator`; docs/readouts.md is a guide."""

    def checked_call(
        self,
        state: State | HistoryState,
        after: State | HistoryState | Tensor,
        forces: Tensor | None,
        targets: Targets | None,
    ) -> AdjointCall:
        """The step from a state to the positions `after`, with all arguments checked."""
        forces = self.check_state(state, forces=forces)
        before, positions = self.positions_of(state), self.positions_of(after, "after")
        check_like("after", positions, before, "m")
        material = self.with_history(self.material_at(targets, len(before)), state)
        check_environments("state", len(before), named_material(material))
        forces = self.forces_at(state, forces, targets, material)
        return AdjointCall(before, state[1], forces, positions, material, list(self.plan.arrays), self.time_step)

    def forces_at(
        self, state: State | HistoryState, forces: Tensor | None, targets: Targets | None, material: list[Tensor]
    ) -> Tensor | None:
        """All forces of a step from a checked state: `forces`, and those of pressure and wind."""
        if self.loads is None:
            return forces
        refuse_forward_mode(state[0], state[1])
        positions, named = self.positions_of(state), named_material(material)
        values = self.load_values(targets, len(positions))
        check_environments("state", len(positions), {"masses": named["masses"], **values})
        own = self.loads.forces((positions, state[1]), named["masses"], self.time_step, values)
        return own if forces is None else forces + own

    def collider_inputs(self, state: State | HistoryState, targets: Targets | None) -> ColliderInputs:
        """What moves colliders in a step from a checked state."""
        if self.body_contact is None:
            return NO_INPUTS
        if isinstance(targets, Mapping):
            self.body_contact.check_transforms(*targets.values())
        poses: Tensor = state[2][0]  # type: ignore[misc]
        return ColliderInputs(self.anchors.place_colliders(targets, poses), self.anchors.place_wrenches(targets, poses))

    def load_values(self, targets: Targets | None, batch: int) -> dict[str, Tensor]:
        """The arrays `pressure` and `wind` of a step, those that the scene has."""
        own = {row.name: getattr(self, row.name) for row in LOAD_ROWS if row.name in self.material_names}
        return self.anchors.place_loads(targets, own, batch=batch)

    def load_forces(self, state: State | HistoryState, targets: Targets | None = None) -> Tensor:
        """Forces of pressure and wind on the vertices [B, V, 3] [N] in a step from `state`. Differentiable.

        They are those at the start of the step. A step adds them to its `forces`, so no one has to give them.

        Args:
            state: start of the step.
            targets: as in `forward`, the same as in that step.
        """
        self.check_state(state)
        positions = self.positions_of(state)
        found = self.forces_at(state, None, targets, self.material_at(targets, len(positions)))
        return torch.zeros_like(positions) if found is None else found

    def contact_forces(
        self,
        state: State | HistoryState,
        after: State | HistoryState | Tensor,
        forces: Tensor | None = None,
        targets: Targets | None = None,
        *,
        about: Tensor | None = None,
    ) -> ContactForces:
        """Forces of all contacts on the vertices [N] in the step from `state` to `after`.

        Those between the surfaces of `Contact` are the ones that the step left in `after.history`. Those of grounds and
        spheres are the part of the remaining gradient of the objective at `after` that these can supply: normal forces,
        and friction up to Coulomb's bound. If several hold a vertex, normal forces are fitted to the gradient, and
        friction is shared; `torchpd.simulation.readouts` states the rule. `residual` is the part that neither contacts
        nor pins balance: compare it with the forces to see how far to trust them. Hard pins take the whole gradient at
        their vertices. Differentiable, at fixed `after.history`.

        Args:
            state: start of the step.
            after: end of the step, a `State` or positions [B, V, 3]; with `Contact` the `HistoryState` that it
                returned.
            forces: as in `forward`, the same as in that step.
            targets: as in `forward`, the same as in that step.
            about: point of torques [3] or [B, 3] [m]; by default the centre of mass of each body at `after`, and the
                actual origin of each collider.

        Returns:
            Forces of all contacts [B, V, 3], and of each ground and sphere: `contacts.colliders[ground].force`. Sums
            and torques by body and `Collider`: `contacts.bodies[solid].force` [B, 3]. Of two that touch, on the first:
            `contacts.between[cube, table].force` [B, 3]. All wrenches on colliders [B, C, 6]: `contacts.on_colliders`.
            Pair by pair: `contacts.pairs`. What the scene lacks is empty.

        Example:
            >>> after = sim(state)
            >>> contacts = sim.contact_forces(state, after)
            >>> contacts.bodies[cube].force  # [B, 3] N, of a cube at rest its weight, upwards
        """
        call = self.checked_call(state, after, forces, targets)
        return contact_forces(self.scene, call, about, self._met(after))

    def _met(self, after: State | HistoryState | Tensor) -> Met | None:
        """What surfaces did to each other in a step to `after`, which is checked; None without `Contact`."""
        if self.body_contact is None:
            return None
        if isinstance(after, Tensor):
            raise TypeError(
                "after must be a HistoryState in a scene with Contact, whose history has the forces between surfaces, "
                "got positions alone; give the state that the step returned"
            )
        history = ContactHistory(*after[2])  # type: ignore[misc]
        return pair_forces(self.body_contact.surfaces(self.contact_thickness), after[0], history)

    def reactions(
        self,
        state: State | HistoryState,
        after: State | HistoryState | Tensor,
        forces: Tensor | None = None,
        targets: Targets | None = None,
        *,
        about: Tensor | None = None,
    ) -> Reactions:
        """Forces of pins and ties on their vertices [N] in the step from `state` to `after`.

        The force of a hard pin is the gradient of the step's objective without pins, that of a soft one k (target -
        x'). The force of a hard pin therefore includes those of grounds and spheres at its vertices, and the residual
        of the solve there, but not those between surfaces of `Contact`. The residual of other vertices is
        `ContactForces.residual`. A tie pulls its vertex by k (point - x'). Differentiable.

        Args:
            state, after, forces, targets, about: as in `contact_forces`.

        Returns:
            Forces in the order of `pin_targets` [B, P, 3] and on all vertices [B, V, 3], and by pin:
            `reactions.pins[pin].wrench.force` [B, 3] is its total, and `reactions.ties[tie].force` [B, n, 3] the force
            on the vertices of a tie. `pins` and `ties` are empty if the scene has none.
        """
        call = self.checked_call(state, after, forces, targets)
        return reactions(self.scene, call, about, self._met(after))

    def stress(self, state: State | HistoryState | Tensor) -> Stress:
        """Cauchy stress [B, E, 3, 3] and von Mises stress [B, E] [Pa] of every tetrahedron, and its strain.

        sigma = w (F - R) F^T / det F without a Poisson's ratio, with w Young's modulus, F the deformation gradient and
        R its nearest rotation; `torchpd.simulation.stress` has the formula with one. NaN unless det F > 0, see
        `Stress.inverted`. Differentiable.

        Args:
            state: a `State`, or positions [B, V, 3].
        """
        positions = self.positions_of(state)
        rows = named_material(self.with_history(self.material(), state))
        rows = {name: rows[name] for name in STRESS_ROWS if name in self.material_names}
        check_environments("state", len(positions), rows)
        return stress(self.scene, positions, rows)

    def check(self, state: State | HistoryState) -> None:
        """Refuse a state that no step takes: its shapes, what is not finite, surfaces of `Contact` that cross or touch.

        A step checks no values. What a simulator returns is free of crossings; check states of your own once. A body
        that lies whole inside another one crosses nothing, and is not seen: docs/contact.md#what-is-checked.

        Args:
            state: as in `forward`.

        Raises:
            ValueError: names the environment, and what is not finite, the edge and triangle that cross, or the sides
                that touch.
        """
        self.check_state(state)
        self.positions_of(state)
        for name, array in (("positions", state[0]), ("velocities", state[1])):
            if not bool(array.isfinite().all()):
                environment = int((~array.isfinite()).flatten(1).any(dim=1).nonzero()[0])
                raise ValueError(f"check: {name} must be finite, got others in environment {environment}; reset it")
        if self.body_contact is not None:
            self.body_contact.check(state)

    def plastic_strain(self, state: HistoryState) -> dict[Solid, Tensor]:
        """Flow alpha [B, E] that the tetrahedra of every plastic solid have accumulated. Differentiable.

        The sum of the norms of the log strains of flow in each step; sqrt(2/3) of it is the equivalent plastic strain.

        Args:
            state: a `HistoryState`.
        """
        self.check_state(state)
        if not self._flows:
            return {}
        return plastic_strain(self.scene, named_material(self.with_history(self.material(), state))["flow"])

    def membrane_stress(self, state: State | HistoryState | Tensor) -> dict[Cloth, MembraneStress]:
        """Cauchy stress [N/m] of every triangle by cloth, membrane and threads together, with its strain.

        A force per length of the present triangle, in the axes of its rest plane, which turn with it. Those axes are
        the ones of `rest_uv`, or else the first edge and its normal in the plane. NaN in triangles without an area.
        Differentiable.

        Args:
            state: a `State`, or positions [B, V, 3].

        Example:
            >>> tension = sim.membrane_stress(state)[shirt].principal[..., 0]  # [B, F] N/m, the largest
        """
        positions, material = self._material_for(state, None)
        return membrane_stress(self.scene, positions, material)

    def tensions(
        self, state: State | HistoryState | Tensor, targets: Targets | None = None
    ) -> dict[Rod | Springs | Fibres, Tension]:
        """Tension and strain of every segment of rods, spring and fibre, by part.

        k (length - rest length) [N] for springs and segments. For fibres w (|F f| - L) [Pa], 0 where they are slack.
        Strains are relative to the length at rest: for fibres to that of the mesh. Differentiable.

        Args:
            state: a `State`, or positions [B, V, 3].
            targets: activations of fibres, as in `forward`.
        """
        positions, material = self._material_for(state, targets)
        return tensions(self.scene, positions, material)

    def volume(self, state: State | HistoryState | Tensor) -> dict[Body, Tensor]:
        """Volume [B] m^3 of every solid, and of every cloth that is closed. Differentiable.

        Inverted tetrahedra count as negative. A closed cloth has the volume that its triangles enclose, negative if
        they run clockwise seen from outside.

        Args:
            state: a `State`, or positions [B, V, 3].
        """
        return volumes(self.scene, self.positions_of(state))

    def _material_for(
        self, state: State | HistoryState | Tensor, targets: Targets | None
    ) -> tuple[Tensor, dict[str, Tensor]]:
        positions = self.positions_of(state)
        material = named_material(self.material_at(targets, len(positions)))
        check_environments("state", len(positions), material)
        return positions, material

    def vertex_average(self, values: Tensor) -> Tensor:
        """Average at every vertex of values of its tetrahedra, weighted by their rest volumes. Differentiable.

        For colours and contours of a field that jumps between tetrahedra, such as `stress(state).von_mises`. It is NaN
        at vertices of inverted tetrahedra, whose stress is NaN, and 0 at vertices without tetrahedra.

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
        """Write a state as `.vtu` for ParaView; a track or a list of states as a `.pvd` with one numbered `.vtu` each.

        Files have displacement and velocity of vertices, and the body of cells: tetrahedra, then triangles, then lines.
        Cells have stress, tension and strain by their kind; `torchpd.simulation.vtu` has the names.

        Args:
            path: of the .vtu, or of the .pvd, beside which the others go; existing files are replaced.
            states: a state, a track, or a list of states.
            environment: number of the environment; needed if states have several.
            times: of the records [s]; by default h, 2 h, ... as of a rollout that records every step.
            point_data: further fields of vertices by name: [B, V, ...], of several states [T, B, V, ...], or [V, ...]
                for all of them. Tensors or arrays.
            cell_data: further fields of cells, with their number in place of V.

        Returns:
            The path.
        """

        def check(state: State | HistoryState) -> None:
            self.check_state(state)
            self.positions_of(state)

        return write_vtu(self.compiled, check, path, states, environment, times, point_data, cell_data)
