"""What nodes on several machines tell each other: messages as bytes, and what waits to be fetched.

Knows no network: drivers.system.zenoh_bus has that. docs/topics.md is the schema.
"""
