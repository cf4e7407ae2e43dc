"""From a frame to two whitened signals, their noise and their discontinuities (sections 2, 3, 8).

Knows pixels and sensors, no regions. May import: `compute`, `frame`, `config`. For others: `Signals` and
`build_signals`, `NoiseModel`, `detect_edges`, `normalize_reflectance`, `UNIT_PX`.
"""
