"""Which mass belongs to a contrast?  The mass scale from standards."""
