"""Bundle adjustment and its factors, pose graph, and the minimal and refined pose solvers."""
