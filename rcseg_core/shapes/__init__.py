"""Beyond the paper: planes, spheres and cylinders in metres, with errors that exist.

Knows a surface's cells and their noise. May import: `decision`, `models`, `signal`, `frame`. For others:
`Primitive`, `LocalPlane`, `LocalSphere`, `LocalCylinder`.
"""
