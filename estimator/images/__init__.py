"""What any image processing here needs: the noise of an image.

In: a grey image. Out: its noise as a function of the grey level. Read ``noise`` first.
"""
