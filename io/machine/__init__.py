"""The machine that telerig runs on: its cores, its memory, the installation.

Read ``parallel`` first.
"""
