"""Write the files of a scene folder from the stages' results."""
