"""The live rangefinder: protocol, driver, emulator."""
