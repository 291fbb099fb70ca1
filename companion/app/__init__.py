"""Commands: arguments become one call each, its outcome an exit status.

May import everything; nothing imports it.
"""
