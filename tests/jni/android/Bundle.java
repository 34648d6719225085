package android.os;

/** As far as org.psao.android uses it. */
public class Bundle {}
