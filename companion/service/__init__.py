"""Installation of the program as a service, and its removal."""
