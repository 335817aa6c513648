"""Commands of `python -m torchpd`."""

__all__: list[str] = []
