"""Make the pictures and tables of the pages in docs/, and the generated scenes."""
