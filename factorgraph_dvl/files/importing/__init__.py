"""Raw files of instruments into trial folders: what `import` does, step by step."""
