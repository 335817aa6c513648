"""Gmsh's element types."""

from __future__ import annotations

__all__ = ["TYPES"]

_NODES = {
    ("vertex", 0): {15: 1},
    ("line", 1): {1: 2, 8: 3, 26: 4, 27: 5, 28: 6, 62: 7, 63: 8, 64: 9, 65: 10, 66: 11},
    ("triangle", 2): {
        2: 3,
        9: 6,
        20: 9,
        21: 10,
        22: 12,
        23: 15,
        24: 15,
        25: 21,
        42: 28,
        43: 36,
        44: 45,
        45: 55,
        46: 66,
    },
    ("quad", 2): {3: 4, 10: 9, 16: 8, 36: 16, 37: 25, 38: 36, 47: 49, 48: 64, 49: 81, 50: 100, 51: 121},
    ("tetra", 3): {4: 4, 11: 10, 29: 20, 30: 35, 31: 56, 71: 84, 72: 120, 73: 165, 74: 220, 75: 286},
    ("hexahedron", 3): {5: 8, 12: 27, 17: 20, 92: 64, 93: 125, 94: 216, 95: 343, 96: 512, 97: 729, 98: 1000},
    ("wedge", 3): {6: 6, 13: 18, 18: 15, 90: 40, 91: 75, 106: 126, 107: 196, 108: 288, 109: 405, 110: 550},
    ("pyramid", 3): {7: 5, 14: 14, 19: 13},
}

# by type number: kind of the cell, its node count (corners first), and its dimension
TYPES = {
    number: (kind, count, dimension) for (kind, dimension), counts in _NODES.items() for number, count in counts.items()
}
