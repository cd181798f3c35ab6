"""The machine that telerig runs on: its cores, its memory, the installation.

Read ``parallel`` first; ``room`` refuses work for which there is too little memory or disk.
"""
