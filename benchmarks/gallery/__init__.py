"""Pictures of finished models of public sets and of rendered scenes, for the pages."""
