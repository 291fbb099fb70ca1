"""Stages in processes of their own: what is heavy can neither delay nor bring down what flies."""
