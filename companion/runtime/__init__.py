"""How stages are run: in order or as processes; mailboxes, frame ring, load levels, gaps.

Knows stages by their messages only; what each of them does is in `stages`.
"""
