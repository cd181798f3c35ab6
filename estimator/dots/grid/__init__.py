"""The numbering of dots: which dot of the target is which dot of the image.

In: unordered dots. Out: row and column of each. Read ``numbering`` first; ``lattice`` finds the
grid, ``arrangement`` serves targets without one, and ``agreement`` compares two cameras.
"""
