"""Mappings from parts of a scene to what a step did to them."""

from __future__ import annotations

from typing import Any, NoReturn, TypeVar

from torch.utils import _pytree as pytree

__all__ = ["ByPart"]

_Key = TypeVar("_Key")
_Value = TypeVar("_Value")


class ByPart(dict[_Key, _Value]):
    """A dict by parts of a scene, or by pairs of them, whose `KeyError` says which keys there are."""

    def __missing__(self, key: Any) -> NoReturn:
        kinds = ", ".join(dict.fromkeys(map(_kind_of, self))) or "none"
        raise KeyError(
            f"keys must be parts of sim.scene, here {len(self)}: {kinds}; got another {_kind_of(key)}. Parts go by "
            "identity: Simulator.load makes new bodies and colliders, sim.scene.bodies and sim.scene.colliders"
        )


def _kind_of(key: Any) -> str:
    return f"({', '.join(map(_kind_of, key))})" if isinstance(key, tuple) else type(key).__name__


pytree.register_pytree_node(
    ByPart,
    lambda mapping: (list(mapping.values()), list(mapping)),
    lambda values, keys: ByPart(zip(keys, values, strict=True)),
    serialized_type_name="torchpd.ByPart",
    flatten_with_keys_fn=lambda mapping: (
        [(pytree.MappingKey(key), value) for key, value in mapping.items()],
        list(mapping),
    ),
)
