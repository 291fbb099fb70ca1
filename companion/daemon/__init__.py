"""The daemon: what runs while a drone is switched on."""
