"""The compiled kinds of stencils against the reference: energy, gradient, second derivatives, diagonal, materials."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from element_cases import ELEMENT_CASES, STATES, ElementCase, RandomElements, random_elements
from runs import ULP
from stencil_scenes import bare_values, chain, pulled_spring
from torch import Tensor

from torchpd.common.tables import KINDS, MATERIAL_TABLE
from torchpd.ops.diagonal import named_material
from torchpd.plan.cpu_plan import compile_plan
from torchpd.plan.material import effect_rows, material_of, material_rows
from torchpd.reference.groups import ElementGroup
from torchpd.scene.scene import SceneValues
from torchpd.scene.stencils import KINDS as SCENE_KINDS
from torchpd.scene.stencils import StencilGroup

ops = torch.ops.torchpd
COUNT = 20000
DTYPES = (torch.float32, torch.float64)
# kinds that need no tetrahedra besides
ALONE = [name for name, kind in KINDS.items() if not kind.of_tets]
# roundings of a sum of up to thirty products and sums, in the extension and in the reference
ROUNDINGS = 60.0


def values_of(group: StencilGroup, vertices: int) -> SceneValues:
    """A scene of these stencils alone."""
    return bare_values(np.zeros((vertices, 3)), np.ones(vertices), [group], np.zeros(0, dtype=np.int64))


class Compiled:
    """The ops on one group of stencils, whose positions are [V, 3]."""

    def __init__(self, group: StencilGroup, positions: np.ndarray, dtype: torch.dtype) -> None:
        values = values_of(group, len(positions))
        self.plan = list(compile_plan(values, dtype=dtype, progress=False).arrays)
        self.material = material_rows(material_of(values, dtype))
        self.positions = torch.tensor(positions, dtype=dtype)[None]

    def at(self, moved: Tensor | None = None) -> tuple[Tensor, list[Tensor], list[Tensor]]:
        return (self.positions if moved is None else moved), self.material, self.plan

    def energies(self, kind: str, moved: Tensor | None = None) -> np.ndarray:
        """Energy of each stencil: all are proportional to the first row, or to its last number."""
        x, material, plan = self.at(moved)
        first = [row.name for row in MATERIAL_TABLE].index(KINDS[kind].rows[0])
        products = ops.effect_products(x, None, material, plan)
        core = len(MATERIAL_TABLE) - len(products)
        shares = (material[first] * products[first - core][0]).double()
        return np.asarray(shares if shares.dim() == 1 else shares[:, -1])


def reference_of(given: RandomElements) -> ElementGroup:
    numbers = np.arange(len(given.group.corners))
    return ElementGroup(given.group, numbers, np.zeros_like(given.positions), 0.1)


def by_class(given: RandomElements) -> RandomElements:
    """The elements class by class: positions are kept relative to their patch, which should hold no huge ones."""
    count = len(given.group.corners)
    order = np.argsort(np.arange(count) % len(STATES), kind="stable")
    group = given.group
    chosen = StencilGroup(
        kind=group.kind,
        corners=group.corners,
        gradients=group.gradients[order],
        measure=group.measure[order],
        constants=group.constants[order],
        material={name: row[order] for name, row in group.material.items()},
    )
    return RandomElements(chosen, given.positions.reshape(count, -1, 3)[order].reshape(-1, 3))


def test_the_tables_of_scene_and_extension_are_one() -> None:
    assert list(SCENE_KINDS) == list(KINDS)
    for name, kind in KINDS.items():
        own = SCENE_KINDS[name]
        assert (own.corners, own.columns, own.constants, own.rows, own.of_tets) == (
            kind.corners, kind.columns, kind.constants, kind.rows, kind.of_tets
        )  # fmt: skip


@pytest.mark.parametrize("case", [case for case in ELEMENT_CASES if case.kind in ALONE], ids=lambda case: case.name)
@pytest.mark.parametrize("dtype", DTYPES)
def test_known_elements(case: ElementCase, dtype: torch.dtype) -> None:
    """Closed forms: the energy, and P as the gradient of a simplex with g_a the unit vectors."""
    compiled = Compiled(case.group(), case.positions, dtype)
    tolerance = 1e-9 if dtype == torch.float64 else 20 * ULP[dtype]
    assert ops.effect_energy(*compiled.at()).item() == pytest.approx(case.energy, rel=tolerance, abs=tolerance)
    gradient = ops.gradient(*compiled.at())[0]
    for (i, j), value in case.stress.items():
        # the force on corner a is P g_a; a simplex has g_a along axis a - 1
        corner = j + 1 if case.gradients.shape[1] > 1 else int(np.abs(case.gradients[:, 0]).argmax())
        expected = value * case.gradients[corner, j]
        assert gradient[corner, i].item() == pytest.approx(expected, abs=max(tolerance, 1e-9))


@pytest.mark.parametrize("kind", ALONE)
@pytest.mark.parametrize("dtype", DTYPES)
def test_the_reference_finds_the_same(kind: str, dtype: torch.dtype) -> None:
    given = random_elements(kind, (KINDS[kind].corners, KINDS[kind].columns), 700)
    reference, compiled = reference_of(given), Compiled(given.group, given.positions, dtype)
    corners, law = KINDS[kind].corners, reference.law
    deformation = reference.deformation(given.positions)
    energies, stress = law.evaluate(deformation)
    # an error of F, of |g_a| |x_a|, passes into P times the weight of the majoriser, and into R divided by the smallest
    # stretch; R is as long as the rest length
    gradients = np.sqrt((given.group.gradients**2).sum(axis=2))
    reach = np.sqrt((given.positions**2).sum(axis=1)).reshape(-1, corners)
    error = ROUNDINGS * ULP[dtype] * ((gradients * reach).sum(axis=1) + 1.0)
    weight = law.measure * (law.quadratic + corners * law.trace)
    stretches = np.linalg.svd(deformation, compute_uv=False)
    longest = stretches.max(axis=1) + 2.0
    slack = weight * error * (1.0 + longest / np.maximum(stretches.min(axis=1), 1e-300))

    assert (np.abs(compiled.energies(kind) - energies) <= weight * error * (longest + error)).all()
    gradient = np.asarray(ops.gradient(*compiled.at())[0].double())
    wrong = np.sqrt(((gradient - reference.nodal(stress)) ** 2).sum(axis=1)).reshape(-1, corners)
    assert (wrong <= slack[:, None] * gradients.max(axis=1, keepdims=True)).all()
    bound = np.asarray(ops.elastic_diagonal(compiled.material, compiled.plan, weighted=True).double())
    # g of the first corner is minus the sum of the others
    largest = reference.weighted_diagonal.reshape(-1, corners).max(axis=1).repeat(corners)
    assert (np.abs(bound - reference.weighted_diagonal) <= max(ROUNDINGS * ULP[dtype], 1e-11) * largest).all()


@pytest.mark.parametrize("kind", ALONE)
def test_derivatives_are_those_of_differences(kind: str) -> None:
    """Second derivatives by positions and first ones by every row, in smooth states."""
    given = random_elements(kind, (KINDS[kind].corners, KINDS[kind].columns), 140)
    x = torch.tensor(given.positions)[None]
    compiled = Compiled(given.group, given.positions, torch.float64)
    _, material, plan = compiled.at()
    generator = torch.Generator().manual_seed(1)
    direction = torch.randn(x.shape, generator=generator, dtype=x.dtype)
    step = 1e-6

    def gradient(shift: float) -> Tensor:
        return ops.gradient(x + shift * direction, material, plan)

    product = ops.hessian_product(x, direction, material, plan)
    difference = (gradient(step) - gradient(-step)) / (2.0 * step)
    scale = ops.elastic_diagonal(material, plan, weighted=True).reshape(-1, KINDS[kind].corners).amax(1)
    scale = scale.repeat_interleave(KINDS[kind].corners)[None, :, None]
    wrong = ((product - difference).abs() > 1e-5 * scale).any(-1).reshape(-1, KINDS[kind].corners).any(-1)
    # kinks: a slack fibre, a cap, a collapsed state
    assert int(wrong.sum()) <= 140 // 7 + 3

    rows = [row.name for row in MATERIAL_TABLE]
    for name in KINDS[kind].rows:
        place = rows.index(name)
        leaves = [array.detach() for array in material]
        leaves[place] = leaves[place].clone().requires_grad_()
        energy = ops.effect_energy(x, leaves, plan)
        (by_energy,) = torch.autograd.grad(energy.sum(), leaves[place])
        (by_gradient,) = torch.autograd.grad((ops.gradient(x, leaves, plan) * direction).sum(), leaves[place])
        assert torch.equal(by_gradient, ops.effect_products(x, direction, material, plan)[place - 8][0])
        assert by_energy.isfinite().all()
        row = leaves[place].detach()
        for number in range(row[0].numel()):
            only = torch.zeros_like(row)
            only.reshape(140, -1)[:, number] = 1.0

            def chosen(array: Tensor, only: Tensor = only) -> Tensor:
                return (array * only).reshape(140, -1).sum(1)

            h = 1e-6 * (1.0 + row.abs()) * only
            # each stencil has its own row: differences of its corners alone
            forces = []
            for moved in (row + h, row - h):
                own = ops.gradient(x, [*leaves[:place], moved, *leaves[place + 1 :]], plan)
                forces.append((own * direction).sum(-1).reshape(-1, KINDS[kind].corners).sum(-1))
            slope = (forces[0] - forces[1]) / (2.0 * chosen(h))
            far = (chosen(by_gradient) - slope).abs() > 1e-5 * (1.0 + slope.abs() + forces[0].abs() / chosen(row).abs())
            assert int(far.sum()) <= 140 // 7 + 3


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("kind", ALONE)
def test_every_step_of_the_diagonal_lowers_the_energy(kind: str, dtype: torch.dtype) -> None:
    """x - theta g / D lowers E by theta (1 - theta / 2) g^T g / D at least, in states of all classes."""
    corners = KINDS[kind].corners
    given = by_class(random_elements(kind, (corners, KINDS[kind].columns), COUNT))
    compiled = Compiled(given.group, given.positions, dtype)
    x, material, plan = compiled.at()
    diagonal = ops.elastic_diagonal(material, plan, weighted=True).clamp_min(1e-30)[:, None]
    gradient = ops.gradient(x, material, plan)
    before = compiled.energies(kind)

    def of_stencils(field: Tensor) -> np.ndarray:
        return np.asarray(field.double().sum(-1).reshape(-1, corners).sum(-1))

    descent = of_stencils(gradient**2 / diagonal)
    law = reference_of(given).law
    size = of_stencils(x**2 * diagonal) + 4.0 * law.measure * (law.quadratic + corners * law.trace)  # lengths up to 2 m
    # the force on the first corner is minus the sum of the others, which may cancel
    gradients = np.sqrt((given.group.gradients**2).sum(axis=2))
    cancels = gradients.max(axis=1) / np.where(gradients > 0.0, gradients, np.inf).min(axis=1)
    rounding = ROUNDINGS * ULP[dtype] * cancels * (before + descent + size)
    for theta in (0.3, 1.0, 1.9):
        after = compiled.energies(kind, x - theta * gradient / diagonal)
        assert (after <= before - theta * (1.0 - theta / 2.0) * descent + rounding).all()


@pytest.mark.parametrize("scene", [pulled_spring, chain])
def test_rows_follow_the_table(scene: object) -> None:
    """Arrays that a scene lacks are empty, and the others stand in the order of the table."""
    values = scene().values  # type: ignore[operator]
    assert list(effect_rows(values)) == ["spring_stiffness", "rest_length"]
    rows = named_material(material_rows(material_of(values, torch.float64)))
    assert rows["thickness"].numel() == 0
    assert rows["rest_length"].tolist() == values.stencils[0].material["rest_length"].tolist()
