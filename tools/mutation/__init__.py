"""Small changes of modules (changes), which tests are a module's own (project), and their run with a change (trial)."""
