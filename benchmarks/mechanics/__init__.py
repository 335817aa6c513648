"""Cases of `benchmarks/validation.py`: scenes whose equilibrium or motion has a closed form or a published value."""
