"""Simulated devices on pseudo-terminals, to practise recording with.

Read ``devices`` first.
"""
