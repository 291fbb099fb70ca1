"""Benchmarks against truth and against other programs; their tables, pictures and C reference."""
