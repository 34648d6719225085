package android.net;

/** As far as org.psao.android uses it. */
public class Network {}
