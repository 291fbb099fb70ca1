"""The commands: arguments turned into one call each, and what came of it as an exit status.

May import everything; nothing imports it.
"""
