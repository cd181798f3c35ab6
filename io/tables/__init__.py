"""Every CSV table that telerig reads or writes, declared once.

A declaration names the columns with unit and meaning. Readers check against it, exports take units
from it, and ``python docs/tables.py`` writes the tables of docs/files.md from it. A new column is
one line here, and its values where the table is made. Read ``table`` first.
"""
