"""Simulations written and read, and their description."""

__all__: list[str] = []
