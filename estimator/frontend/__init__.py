"""From images to measurements: dots, their numbering, bubbles."""
