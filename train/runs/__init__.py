"""Write run folders for configs, and read them back."""
