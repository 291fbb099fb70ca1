"""Rotations, rigid transforms, camera models, geodesy. numpy only; imports no other package."""
