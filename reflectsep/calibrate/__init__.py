"""From stored pictures to a photometric stack: exposure and response, saturation, lights and their alpha."""
