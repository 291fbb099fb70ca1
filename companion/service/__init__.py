"""The program as a service of this computer: set up, and taken away again."""
