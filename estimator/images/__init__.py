"""Properties of an image that dots and bubbles both need: its noise, and whether it is one at all.

In: a grey image. Out: its noise as a function of the grey level, or an error. Read ``noise`` first.
"""
