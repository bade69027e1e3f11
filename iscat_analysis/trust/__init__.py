"""How far can it be believed?  Measured spread, empty places, systematic errors."""
