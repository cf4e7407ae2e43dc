"""Results in the messages of other packages: one small pure module for each package.

Every function builds with `make(type name, **fields)`, field by field after the package's public definitions,
so that none of these packages is needed to import or to test this one. `available` tells whether one is
installed, `load` imports a message class or says in a line what to install.
"""

from rcseg_ros.bridges.packages import BRIDGES, Bridge, available, load

__all__ = ["BRIDGES", "Bridge", "available", "load"]
