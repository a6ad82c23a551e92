// The tables hold a row per control interval (film) or region (choices) for every source that changes with it.
const k = Math.round(slider.value / slider.step)
const put = (tables, row) => {
  for (const [source, table, columns] of tables) {
    for (const name of columns) source.data[name] = table.data[name][row]
    source.change.emit()
  }
}
if (cb_obj === region) {
  put(choices, Number(region.value))
  titles.forEach((title, n) => { title.text = texts[n][Number(region.value)] })
}
put(film, k)
numbers.text = words[k]
for (const span of spans) span.location = slider.value
for (const one of present) one.indices = k > 0 ? [k] : []
