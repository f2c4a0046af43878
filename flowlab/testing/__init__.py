"""What authors of plug-ins test them with; needs nothing that flowlab itself does not."""
