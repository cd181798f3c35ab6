"""The parts that every page is made of: templates, figures, numbers, tables of a results folder.

Read ``page`` first.
"""
