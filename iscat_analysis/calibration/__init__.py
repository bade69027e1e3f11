"""What is the instrument?  Its camera from the noise, its mass scale from standards."""
