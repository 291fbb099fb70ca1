"""A flight on several computers: which stages run where, and the node that makes the cloud."""
