"""The nn.Module that steps, its state, material, read-outs, rollout and CUDA graph."""

__all__: list[str] = []
