"""Execution of stages: in order or as processes; mailboxes, frame ring, load levels, gaps.

Knows stages by their messages only; their work is in `stages`.
"""
