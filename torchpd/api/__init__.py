"""The public classes as facades over the packages below."""

__all__: list[str] = []
