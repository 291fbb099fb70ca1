"""Loops over arrays, compiled to machine code: what each frame does to hundreds of points.

They hold no interpreter lock, so that tracking and mapping run beside each other. Compiled when
they are imported, before any flight, and kept on disk for the next start. What one calls lies in
the file where it is: a kept one is made anew where its own file has changed, and no other.
"""
