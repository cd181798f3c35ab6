"""Simulated devices on pseudo-terminals, to practise recording with.

In: a list of devices (``practice``). Out: serial ports that send what the devices would send
(``signals``), and what was sent. Read ``devices`` first.
"""
