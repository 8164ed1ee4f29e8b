"""Pictures, films and pages of results: people look before they read."""
