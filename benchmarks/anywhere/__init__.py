"""Does the program install and run on other systems: Pythons, platforms, a bare container."""
