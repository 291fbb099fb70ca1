"""Messages between nodes on several machines: encoding, and bundles to be fetched.

Knows no network: drivers.system.zenoh_bus has that. docs/topics.md is the schema.
"""
