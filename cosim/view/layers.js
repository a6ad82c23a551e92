for (const [label, parts] of layers) {
  for (const part of parts) part.visible = label === cb_obj.value
}
