clearInterval(window.playing)
cb_obj.label = cb_obj.active ? "Pause" : "Play"
const last = () => slider.value > slider.end - slider.step / 2
if (cb_obj.active && last()) slider.value = slider.start
if (cb_obj.active) window.playing = setInterval(() => {
  if (last()) cb_obj.active = false
  else slider.value = Math.min(slider.value + slider.step, slider.end)
}, period)
