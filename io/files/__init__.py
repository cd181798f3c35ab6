"""Files of any kind: written whole or not at all, CSV tables, the record of what made a result.

Read ``atomic`` and ``csv_table`` first.
"""
