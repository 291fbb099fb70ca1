"""Distributed flights: placement of stages on nodes, and the node that makes the cloud."""
