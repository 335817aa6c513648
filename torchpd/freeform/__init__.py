"""Free-form patches: surfaces, fit, rays, transport."""

__all__: list[str] = []
