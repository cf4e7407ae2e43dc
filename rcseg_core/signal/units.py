"""The unit that pixels are counted in where their powers are summed."""

#: Coordinates are pixels divided by this, which keeps eighth powers of a VGA image near one.
UNIT_PX = 32.0
