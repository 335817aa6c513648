"""Readers of mesh files: every format becomes the same `MeshContent`, from which `TetMesh` and `TriMesh` are made."""
