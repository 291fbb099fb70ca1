"""Execution of stages: one table, in order or as processes; parcels, queues, load levels, gaps.

Knows stages by their messages only; their work is in `stages`.
"""
