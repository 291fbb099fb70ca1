"""Bundle adjustment and its factors, pose graph, minimal solvers and pose refinement."""
