"""Pictures of maps and queries."""
