"""The commands, by trade; what a command needs is imported when it runs, so that its help comes at once."""
