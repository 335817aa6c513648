"""Checks of arguments, warnings, tables of arrays, the extension's loading; imports nothing of torchpd."""

__all__: list[str] = []
