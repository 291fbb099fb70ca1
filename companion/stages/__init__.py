"""Stages in processes of their own: heavy work can neither delay nor crash the daemon."""
