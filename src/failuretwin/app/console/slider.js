// A slider: that of the browser, which arrow keys move and screen readers know.
export default {
  template: `<input type="range" :min="low" :max="high" :step="step" :aria-label="label"
    v-model.number="at" @input="$emit('moved', at)">`,
  props: { low: Number, high: Number, step: Number, start: Number, label: String },
  data() {
    return { at: this.start };
  },
  methods: {
    show(at) {
      this.at = at;
    },
  },
};
